"""One instant's sightings to one estimate a person: agreement of the views, pairs, and the fusion asked for."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import fusion, fusion_rivals, triangulation
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.fusion_rivals import Bank
from visfuse_cli.maths.gaussian import inverse, times, transpose, update
from visfuse_cli.maths.multiview import project
from visfuse_cli.records import Array, Gaussian
from visfuse_cli.vision.matching import agree

Rows = NDArray[np.intp]
LEVEL_S = 2.0  # s in which the ground and somebody's height, taken as known, count as one look
RIVALS = {
    "naive": fusion_rivals.naive,
    "kim": fusion_rivals.kim,
    "covariance-intersection": fusion_rivals.covariance_intersection,
}


@dataclass(frozen=True, slots=True)
class Sights:
    """Sightings as flat rows, M of them: whose (M,), of which camera (M,), z (M, 2) px, R (M, 2, 2), dt (M,) s."""

    owner: Rows
    camera: Rows
    z: Array
    R: Array
    dt: Array

    def __len__(self) -> int:
        return len(self.owner)

    def of(self, rows: NDArray[np.bool_]) -> Sights:
        """Some of the rows."""
        return Sights(self.owner[rows], self.camera[rows], self.z[rows], self.R[rows], self.dt[rows])


@dataclass(frozen=True, slots=True)
class Pairs:
    """What pairs of cameras measured: whose (K,), which two cameras (K, 2), y (K, 3) m and R (K, 3, 3).

    `shared` says whether R counts each camera's noise once over all pairs; `lone` are the rows (M,) in no pair.
    """

    owner: Rows
    cameras: NDArray[np.intp]
    y: Array
    R: Array
    lone: NDArray[np.bool_]


def at_one_time(sights: Sights, P: Array, beliefs: Gaussian) -> Sights:
    """The sightings as they would be at the set's own instant: moved by each person's expected velocity."""
    if not len(sights) or not np.any(sights.dt):
        return sights
    _, J = project(P[sights.camera], beliefs.mean[sights.owner, :3])
    J = np.nan_to_num(J)
    way = beliefs.mean[sights.owner, 3:] * sights.dt[:, None]
    doubt = beliefs.cov[sights.owner, 3:, 3:] * (sights.dt**2)[:, None, None]
    return Sights(
        sights.owner, sights.camera, sights.z - times(J, way), sights.R + J @ doubt @ transpose(J), 0 * sights.dt
    )


def consistent(sights: Sights, P: Array, near: Array, gate: float) -> NDArray[np.bool_]:
    """Which rows (M,) agree with the others of the same person on one point, near (T, 3) m."""
    people = len(near)
    good = np.ones(len(sights), dtype=bool)
    if not len(sights):
        return good
    point = near.copy()
    weight = inverse(sights.R)
    off = np.zeros_like(sights.z)
    for _ in range(2):
        pixels, J = project(P[sights.camera], point[sights.owner])
        good &= np.isfinite(pixels).all(axis=-1)
        pixels, J = np.where(good[:, None], pixels, 0), np.where(good[:, None, None], J, 0)
        off = np.where(good[:, None], sights.z - pixels, 0)
        J_W = transpose(J) @ weight
        information, vector = np.tile(1e-6 * np.eye(3), (people, 1, 1)), np.zeros((people, 3))
        np.add.at(information, sights.owner, J_W @ J)
        np.add.at(vector, sights.owner, times(J_W, off))
        step = np.asarray(np.linalg.solve(information, vector[..., None]), dtype=float)[..., 0]
        point = point + step
        off = off - times(J, step[sights.owner])
    chi2, count = np.zeros(people), np.zeros(people)
    np.add.at(chi2, sights.owner, np.sum(off * times(weight, off), axis=-1))
    np.add.at(count, sights.owner, good.astype(float))
    for person in np.flatnonzero(count >= 2):
        if chi2[person] > gate_size(int(2 * count[person] - 3), gate):
            rows = np.flatnonzero((sights.owner == person) & good)
            agreed = agree(P[sights.camera[rows]], sights.z[rows], sights.R[rows])
            good[rows] = False if agreed is None else agreed[1]
    return good


def pair_up(sights: Sights, P: Array, near: Array, count_once: bool = True) -> Pairs:
    """Pairs of each person's cameras, triangulated; near (T, 3) m tells which rays meet too flat to be a pair."""
    first, second = [], []
    order = np.argsort(sights.owner, kind="stable")
    bounds = np.searchsorted(sights.owner[order], np.arange(len(near) + 1))
    for begin, end in pairwise(bounds.tolist()):
        for a, b in triangulation.pairs_of(order[begin:end].tolist()):
            first.append(a)
            second.append(b)
    i, j = np.array(first, dtype=np.intp), np.array(second, dtype=np.intp)
    angle = triangulation.meeting_angle(P, sights.camera[i], sights.camera[j], near[sights.owner[i]])
    i, j = i[angle > triangulation.FLATTEST], j[angle > triangulation.FLATTEST]
    rows = np.column_stack([i, j])
    owner, cameras = sights.owner[i], sights.camera[rows]
    noise = sights.R[rows]
    if count_once:
        noise = noise * fusion.degrees(cameras, owner, len(P))[..., None, None]
    measured, _ = triangulation.triangulate(P[cameras], sights.z[rows], noise)
    good = np.isfinite(measured.mean).all(axis=-1) & np.isfinite(measured.cov).all(axis=(-2, -1))
    lone = np.ones(len(sights), dtype=bool)
    lone[rows[good].ravel()] = False
    return Pairs(owner[good], cameras[good], measured.mean[good], measured.cov[good], lone)


def fuse(method: str, prior: Gaussian, sights: Sights, P: Array, banks: list[Bank | None]) -> Gaussian:
    """Beliefs (T, 6) after one instant's sightings; `banks` (T) of local filters, predicted, are updated in place."""
    if method == "central":
        return fusion.central(prior, sights.owner, P[sights.camera], sights.z, sights.R)
    if method == "closed-loop":
        pairs = pair_up(sights, P, prior.mean[:, :3])
        fused = fusion.closed_loop(prior, pairs.owner, pairs.y, pairs.R)
        alone = sights.of(pairs.lone)
        return fusion.central(fused, alone.owner, P[alone.camera], alone.z, alone.R)
    mean, cov = prior.mean.copy(), prior.cov.copy()
    pairs = pair_up(sights, P, prior.mean[:, :3], count_once=False)
    for person in np.unique(pairs.owner):
        mine = pairs.owner == person
        bank = _bank(banks[person], Gaussian(prior.mean[person], prior.cov[person]), len(P))
        R = np.tile(np.eye(2), (len(P), 1, 1))
        own = sights.owner == person
        R[sights.camera[own]] = sights.R[own]
        noise = fusion_rivals.pair_noise(P, R, pairs.cameras[mine], pairs.y[mine], pairs.R[mine])
        rows = np.array([bank.pairs.index((int(a), int(b))) for a, b in np.sort(pairs.cameras[mine], axis=1)])
        bank = banks[person] = fusion_rivals.updated(bank, rows, pairs.y[mine], noise)
        fused = RIVALS[method](bank)
        mean[person], cov[person] = fused.mean, fused.cov
    return Gaussian(mean, cov)


def stand(belief: Gaussian, level: float, sigma: float, dt: float) -> Gaussian:
    """A belief (n,) of somebody whom one camera alone sees, and who is `level` m up, give or take `sigma`.

    One look's ray and a height are a place. What is assumed is the same in all looks: it counts once in LEVEL_S.
    """
    H = np.eye(1, len(belief.mean), 2)
    R = np.array([[sigma**2 * max(LEVEL_S / max(dt, 1e-3), 1.0)]])
    return update(belief, level - belief.mean[2:3], H, R)[0]


def _bank(bank: Bank | None, belief: Gaussian, cameras: int) -> Bank:
    if bank is not None:
        return bank
    every = tuple((a, b) for a in range(cameras) for b in range(a + 1, cameras))
    return fusion_rivals.started(belief, every)
