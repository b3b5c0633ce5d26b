"""What a whole track says of its own noise: how far its cameras disagree, and how hard the person turns."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.estimate import Sights
from visfuse_cli.fusing.settings import FilterSettings
from visfuse_cli.fusing.tracker import at_rest, held_motion
from visfuse_cli.maths import gaussian
from visfuse_cli.records import Array, Gaussian

BATCH_S = 0.5  # s over which errors are summed: a step, and about what the smoother looks around
PRIOR_BATCHES = 6.0  # batches that the usual noise counts for
USUAL = 1.0  # times the nominal variance
LIMITS = (0.05, 100.0)
POOR = 4.0  # times a camera's usual variance: where a side was hidden, what is left says little about noise
THIN_S = 0.25  # s between looks that do not share a step of the person's
GRID = np.array([0.02, 0.03, 0.05, 0.08, 0.13, 0.21, 0.34, 0.55, 0.9, 1.5, 2.5])  # m/s^2 per root Hz
GRID_SIGMA = 1.5  # of the logarithm of how hard people turn, before anything is known of one


def disagreement(sights: Sights, residual: Array, t: Array) -> tuple[float, float]:
    """The noise of sightings, as shares of the nominal variance: summed over a batch, and in one look.

    residual (M, 2) px of sightings from their smoothed path, t (T,) s. What the cameras err alike does not show.
    """
    sigma = np.sqrt(np.diagonal(sights.R, axis1=1, axis2=2))
    usual = np.ones_like(sigma)
    for camera in np.unique(sights.camera):
        mine = sights.camera == camera
        usual[mine] = np.median(sigma[mine], axis=0)
    count = np.bincount(sights.owner, minlength=len(t))
    together = (count[sights.owner] >= 2)[:, None]  # nobody contradicts a camera that is alone
    good = (sigma**2 < POOR * usual**2) & np.isfinite(residual) & together
    scaled = np.where(good, residual / sigma, 0.0)
    for camera in np.unique(sights.camera):  # what a camera errs by all the time moves no velocity
        mine = sights.camera == camera
        mean = scaled[mine].sum(axis=0) / np.maximum(good[mine].sum(axis=0), 1)
        scaled[mine] = np.where(good[mine], scaled[mine] - mean, 0.0)
    # A path has three degrees of freedom an instant, which take their share of the residuals away.
    used = count[count >= 2]
    if not len(used):
        return USUAL, 1.0
    lost = float(np.mean(2 * used) / np.mean(2 * used - 3))
    batch = ((t[sights.owner] - t[0]) / BATCH_S).astype(int)
    key = batch * (int(sights.camera.max()) + 1) + sights.camera
    sums, members = np.zeros((int(key.max()) + 1, 2)), np.zeros((int(key.max()) + 1, 2))
    np.add.at(sums, key, scaled)
    np.add.at(members, key, good.astype(float))
    full = members > 0
    over_batch = lost * np.sum(sums[full] ** 2) / np.sum(members[full])
    in_one = lost * np.sum(scaled**2) / max(np.sum(good), 1)
    weight = len(np.unique(batch))
    over_batch = (over_batch * weight + USUAL * PRIOR_BATCHES) / (weight + PRIOR_BATCHES)
    return float(np.clip(over_batch, *LIMITS)), float(np.clip(in_one, *LIMITS))


def restlessness(y: Array, R: Array, t: Array, settings: FilterSettings, start: Gaussian) -> float:
    """How hard (m/s^2 per root Hz) a person turns: the likeliest of a grid for measured places y (T, 3), R (T, 3, 3).

    Places THIN_S apart are predicted from each other, in several phases; NaN where nothing was measured.
    """
    expected = settings.sigma_a
    known = np.flatnonzero(np.isfinite(y).all(axis=1))
    if len(known) < 4 or t[known[-1]] - t[known[0]] < 4 * THIN_S:
        return expected
    score = -0.5 * (np.log(GRID / expected) / GRID_SIGMA) ** 2
    step = max(1, round(THIN_S / float(np.median(np.diff(t)))))
    phases = range(0, min(step, 4))
    for phase in phases:
        score += _likelihood(y, R, t, known[phase::step], settings, start) / len(phases)
    return float(np.exp(_peak(np.log(GRID), score)))


def _likelihood(
    y: Array, R: Array, t: Array, used: NDArray[np.intp], settings: FilterSettings, start: Gaussian
) -> Array:
    """Log-likelihoods of a grid of motions for the places `used`."""
    H = np.eye(3, 9)
    cov = start.cov.copy()
    cov[:3, :] = cov[:, :3] = 0.0
    cov[:3, :3] = R[used[0]]
    belief = at_rest(Gaussian(np.concatenate([y[used[0]], np.zeros(3)]), cov), GRID, settings)
    total = np.zeros(len(GRID))
    for before, k in pairwise(used.tolist()):
        F, Q = held_motion(float(t[k] - t[before]), GRID, settings)
        belief = gaussian.predict(belief, F, Q)
        belief, innovation = gaussian.update(belief, y[k] - belief.mean[:, :3], H, R[k])
        total += innovation.log_likelihood
    return total


def _peak(x: Array, score: Array) -> float:
    """Where the parabola through the best grid point and its neighbours is highest."""
    k = int(np.argmax(score))
    if k in (0, len(x) - 1):
        return float(x[k])
    a, b, c = score[k - 1 : k + 2]
    return float(x[k] + (x[k + 1] - x[k]) * 0.5 * (a - c) / min(a - 2 * b + c, -1e-9))
