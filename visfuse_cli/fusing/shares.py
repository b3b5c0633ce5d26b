"""Boxes that count by how likely they are whose: what joint probabilistic data association makes of each camera's.

An association that gives each box to one person at most is wrong now and then where people cross, and does not know it.
Here every box near a person counts by the probability that it is of that person; the noise of what comes of it says how
doubtful that was. Fortmann, Bar-Shalom and Scheffe 1983.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.maths import joint_association, multiview
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.gaussian import log_density, mahalanobis, transpose
from visfuse_cli.records import Array, Gaussian, Sighting
from visfuse_cli.vision.matching import Boxes

LEAST_SHARE = 0.5  # of the boxes near somebody: with less that one is not seen, and a track without its person ends
MARGIN, VAGUE = 0.1, 0.5  # of a picture's size: how far outside, and how doubtfully, somebody may be expected
CLAIMED = 0.5  # share of a box that people have between them from which on it begins nobody


def shared(
    boxes: Boxes, shown: Array, dt: Array, size: Array, P: Array, beliefs: Gaussian, config: FuseConfig
) -> tuple[list[dict[int, Sighting]], NDArray[np.bool_]]:
    """What each camera P (C, 3, 4) of size (C, 2) px tells of people (T), and which boxes (n,) are theirs.

    shown (n, 4) px are the boxes as the pictures show them, dt (n,) s their own times after the beliefs' (T, 6).
    """
    sightings: list[dict[int, Sighting]] = [{} for _ in beliefs.mean]
    claimed = np.zeros(len(boxes))
    for camera in np.unique(boxes.camera):
        rows = np.flatnonzero(boxes.camera == camera)
        expected, spread = _expected(P[camera], beliefs, dt[rows[0]])
        share = _shares(boxes, rows, expected, spread, size[camera], config)
        claimed[rows] = share[:, :-1].sum(axis=0)
        for k in np.flatnonzero(1 - share[:, -1] > LEAST_SHARE):
            best = rows[np.argmax(share[k, :-1])]
            z, R = _as_one(boxes.z[rows] - expected[k], boxes.R[best], spread[k], share[k, :-1])
            sightings[k][int(camera)] = Sighting(expected[k] + z, R, shown[best], float(dt[best]))
    return sightings, claimed > CLAIMED


def _expected(P: Array, beliefs: Gaussian, dt: float) -> tuple[Array, Array]:
    """Where a camera P (3, 4) should see people's tracked points (T, 2) px after dt s, and how surely (T, 2, 2)."""
    move = np.hstack([np.eye(3), dt * np.eye(3)])
    pixels, J = multiview.project(P, beliefs.mean @ move.T)
    J_x = np.nan_to_num(J @ move)
    return pixels, J_x @ beliefs.cov @ transpose(J_x)


def _shares(
    boxes: Boxes, rows: NDArray[np.intp], expected: Array, spread: Array, size: Array, config: FuseConfig
) -> Array:
    """Probabilities (T, n + 1) that a person's box is the j-th of one camera's `rows`; the last: that it has none."""
    person, sight = config.person, config.sight
    residual = boxes.z[rows] - expected[:, None]
    S = spread[:, None] + boxes.R[rows]
    taller = boxes.height[rows] - person.height
    variance = boxes.height_sigma[rows] ** 2 + person.height_sigma**2
    # Whom the camera passes closely, or who is far out of its picture, is not where a Jacobian says.
    aside = np.abs(np.nan_to_num(expected, nan=np.inf) - size / 2) > (0.5 + MARGIN) * size
    vague = np.trace(spread, axis1=-2, axis2=-1) > (VAGUE * size.max()) ** 2
    seen = np.isfinite(residual).all(axis=-1) & ~(aside.any(axis=-1) | vague)[:, None]
    residual = np.where(seen[..., None], residual, 0.0)
    distance = np.where(seen, mahalanobis(residual, S) + taller**2 / variance, np.inf)
    log_likelihood = log_density(residual, S) - 0.5 * (taller**2 / variance + np.log(2 * np.pi * variance))
    near = distance < gate_size(3, sight.gate)
    # Boxes of nobody may be anywhere in the picture and as tall as people can be.
    clutter = sight.false_boxes / (float(np.prod(size)) * (person.tallest - person.shortest))
    return joint_association.probabilities(np.where(near, log_likelihood, -np.inf), sight.detected, clutter)


def _as_one(residual: Array, R: Array, spread: Array, share: Array) -> tuple[Array, Array]:
    """The one measurement that does to a belief what boxes do by their shares (n,): residual (2,), noise (2, 2).

    residual (n, 2) px of the boxes, R (2, 2) the noise of one, spread (2, 2) that of the prediction. The mixture of
    the belief as it was and as each box would have it moves by W K times the mean residual, and its covariance is
    P - K (W S - X) K^T, with W the sum of the shares and X their residuals' second moment less its square.
    """
    S = spread + R
    root = np.linalg.cholesky(S)
    white = np.linalg.solve(root, residual.T).T
    mean = share @ white
    left = share.sum() * np.eye(2) - (share[:, None] * white).T @ white + np.outer(mean, mean)
    values, vectors = np.linalg.eigh(left)
    # Boxes far apart leave more doubt than there was, which no measurement can say: it never lies further off than
    # twice their mean, so that it does no harm to a belief other than this one, as in the pass backwards.
    values = np.clip(values, share.sum() / 2, 1.0)
    whole = root @ vectors / np.sqrt(values)
    return whole @ (whole.T @ np.linalg.solve(root.T, mean)), whole @ whole.T - spread
