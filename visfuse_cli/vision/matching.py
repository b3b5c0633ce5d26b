"""One person seen in several views: which boxes of different cameras are of the same one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import multiview, triangulation
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.gaussian import mahalanobis
from visfuse_cli.records import Array, Gaussian

GATE = 0.999  # probability inside


@dataclass(frozen=True, slots=True)
class Boxes:
    """All boxes of one instant, n of them: what each says about where its person stands and how tall that one is.

    camera (n,); z (n, 2) px the tracked point without distortion, R (n, 2, 2) its noise; ground (n, 2) m and height
    (n,) m with its deviation.
    """

    camera: NDArray[np.intp]
    z: Array
    R: Array
    ground: Gaussian
    height: Array
    height_sigma: Array

    def __len__(self) -> int:
        return len(self.camera)

    def of(self, rows: NDArray[np.bool_]) -> Boxes:
        """Some of the boxes."""
        ground = Gaussian(self.ground.mean[rows], self.ground.cov[rows])
        return Boxes(self.camera[rows], self.z[rows], self.R[rows], ground, self.height[rows], self.height_sigma[rows])


def disagreement(boxes: Boxes, P: Array) -> Array:
    """How badly each two boxes go together (n, n), chi-square; infinite within a camera and outside the gates.

    Epipolar distance of the tracked points, places on the ground, and heights.
    """
    first, second = np.triu_indices(len(boxes), 1)
    other = boxes.camera[first] != boxes.camera[second]
    first, second = first[other], second[other]
    apart = boxes.ground.mean[first] - boxes.ground.mean[second]
    known = np.isfinite(apart).all(axis=-1)
    first, second, apart = first[known], second[known], apart[known]
    total = mahalanobis(apart, boxes.ground.cov[first] + boxes.ground.cov[second])
    total = np.where(total < gate_size(2, GATE), total, np.inf)
    taller = boxes.height[first] - boxes.height[second]
    total += taller**2 / (boxes.height_sigma[first] ** 2 + boxes.height_sigma[second] ** 2)
    total = np.where(total < gate_size(3, GATE), total, np.inf)
    near = np.isfinite(total)
    a, b = first[near], second[near]
    F = multiview.fundamental(P[boxes.camera[a]], P[boxes.camera[b]])
    off = multiview.epipolar_distance(F, boxes.z[a], boxes.z[b])
    spread = (np.trace(boxes.R[a], axis1=1, axis2=2) + np.trace(boxes.R[b], axis1=1, axis2=2)) / 4
    outside = off**2 / spread > gate_size(1, GATE)
    cost = np.full((len(boxes), len(boxes)), np.inf)
    cost[a, b] = cost[b, a] = np.where(outside, np.inf, total[near])
    return cost


def groups(boxes: Boxes, P: Array) -> list[NDArray[np.intp]]:
    """Boxes (indices) of one person each, at most one a camera, the likeliest pairs joined first.

    Two groups are joined where all that is known of both agrees in one place.
    """
    cost = disagreement(boxes, P)
    members = [np.array([k]) for k in range(len(boxes))]
    mean, cov = boxes.ground.mean.copy(), boxes.ground.cov.copy()
    while True:
        a, b = np.unravel_index(int(np.argmin(cost)), cost.shape) if len(boxes) else (0, 0)
        if not len(boxes) or not np.isfinite(cost[a, b]):
            break
        S = np.linalg.inv(cov[a] + cov[b])
        mean[a] += cov[a] @ S @ (mean[b] - mean[a])
        cov[a] = cov[a] @ S @ cov[b]
        members[a] = np.sort(np.concatenate([members[a], members[b]]))
        members[b] = np.array([], dtype=int)
        cost[b], cost[:, b] = np.inf, np.inf
        row = np.full(len(boxes), np.inf)
        used = set(boxes.camera[members[a]].tolist())
        for c in np.flatnonzero(np.isfinite(cost[a])):
            if c == a or not len(members[c]) or used & set(boxes.camera[members[c]].tolist()):
                continue
            apart = mahalanobis(mean[c] - mean[a], cov[a] + cov[c])
            if apart < gate_size(2, GATE):
                row[c] = apart
        cost[a], cost[:, a] = row, row
    return [group for group in members if len(group)]


def agree(P: Array, z: Array, R: Array, least: int = 2) -> tuple[Gaussian, NDArray[np.bool_]] | None:
    """The point (3,) that V sightings z (V, 2), R (V, 2, 2) under P (V, 3, 4) agree on, and which of them do (V,).

    While the reprojection chi-square is outside its gate the view is dropped without which the others agree best.
    None where fewer than `least` are left.
    """
    used = np.ones(len(z), dtype=bool)
    while np.count_nonzero(used) >= max(least, 2):
        index = np.flatnonzero(used)
        point, chi2 = triangulation.triangulate(P[index], z[index], R[index])
        if np.isfinite(point.mean).all() and chi2.sum() < gate_size(2 * len(index) - 3, GATE):
            return point, used
        if len(index) <= max(least, 2):
            return None
        without = []
        for k in range(len(index)):
            kept = np.delete(index, k)
            rest, left = triangulation.triangulate(P[kept], z[kept], R[kept])
            without.append(float(left.sum()) if np.isfinite(rest.mean).all() else np.inf)
        used[index[int(np.argmin(without))]] = False
    return None
