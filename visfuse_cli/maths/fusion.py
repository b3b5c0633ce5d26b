"""The closed loop of local and global estimates, and the centralised filter that bounds it (Wu 2010, sec. 3).

Beliefs are Gaussian over [position (3), velocity (3), ...], T people at once; what is measured comes as flat rows, each
with the person it belongs to. A pair of cameras measures a point (3,) m, its covariance made from each camera's noise
times the number of pairs that camera is in: so the sum over pairs counts every pixel once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import gaussian
from visfuse_cli.maths.gaussian import inverse, symmetrise, times
from visfuse_cli.maths.multiview import project
from visfuse_cli.records import Array, Gaussian, Innovation

Rows = NDArray[np.intp]


def position(states: int) -> Array:
    """C (3, states): a pair measures the position. Wu 2010, eqs. 3, 11."""
    return np.eye(3, states)


def local_estimates(prior: Gaussian, y: Array, R: Array) -> tuple[Gaussian, Innovation]:
    """Local estimates (M, n) after each pair's own measurement y (M, 3), R (M, 3, 3). Wu 2010, eqs. 4-5."""
    return gaussian.update(prior, y - prior.mean[..., :3], position(prior.mean.shape[-1]), R)


def closed_loop(prior: Gaussian, owner: Rows, y: Array, R: Array) -> Gaussian:
    """Global estimate (T, n) from pairs that all began with the fed-back one. Wu 2010, eqs. 12-24, corrected.

    prior (T, n) is what was fed back, predicted; owner (M,) names the person of each pair's y (M, 3), R (M, 3, 3).
    The corrections are summed and P^-1 grows by each pair's own gain in information; who was measured by no pair keeps
    the prediction. Raises LinAlgError where a covariance is not positive definite.
    """
    if not len(owner):
        return prior
    local_prior = Gaussian(prior.mean[owner], prior.cov[owner])  # x_i+ = X+ fed back: Wu 2010, eq. 24
    local, _ = local_estimates(local_prior, y, R)
    p_minus, p_plus = inverse(prior.cov), inverse(local.cov)
    information = p_minus.copy()
    np.add.at(information, owner, p_plus - p_minus[owner])
    P = inverse(symmetrise(information))
    phi = P[owner] @ p_plus  # Phi_i = P+ M^T (p_i+)^-1: Wu 2010, eq. 21, the inverse on the other factor
    correction = np.zeros_like(prior.mean)
    np.add.at(correction, owner, times(phi, local.mean - local_prior.mean))  # a sum: Wu 2010, eq. 22 without B
    seen = np.zeros(len(prior.mean), dtype=bool)
    seen[owner] = True
    return Gaussian(prior.mean + correction, np.where(seen[:, None, None], P, prior.cov))


def central(prior: Gaussian, owner: Rows, P: Array, z: Array, R: Array) -> Gaussian:
    """Estimate (T, n) from all pixels at once: what no fusion of local estimates can better.

    owner (M,) names the person of each sighting z (M, 2) px, R (M, 2, 2), under its camera P (M, 3, 4). All are
    linearised at the prior (T, n). Raises LinAlgError where a covariance is not positive definite.
    """
    if not len(owner):
        return prior
    pixels, J = project(P, prior.mean[owner, :3])
    H = np.zeros((*J.shape[:-1], prior.mean.shape[-1]))
    H[..., :3] = J
    off = z - pixels
    mean, cov = prior.mean.copy(), prior.cov.copy()
    # One sighting of every person a round: the order within a person changes nothing but the last digits.
    turn = _turns(owner)
    for each in range(int(turn.max()) + 1):
        rows = np.flatnonzero((turn == each) & np.isfinite(off).all(axis=-1))
        if not len(rows):
            continue
        who = owner[rows]
        belief = Gaussian(mean[who], cov[who])
        residual = off[rows] - times(H[rows], belief.mean - prior.mean[who])
        after, _ = gaussian.update(belief, residual, H[rows], R[rows])
        mean[who], cov[who] = after.mean, after.cov
    return Gaussian(mean, cov)


def _turns(owner: Rows) -> Rows:
    """How many earlier rows have the same owner (M,)."""
    order = np.argsort(owner, kind="stable")
    ranked = owner[order]
    first = np.searchsorted(ranked, ranked)
    turns = np.empty(len(owner), dtype=np.intp)
    turns[order] = np.arange(len(owner)) - first
    return turns


def degrees(pairs: NDArray[np.intp], owner: Rows, cameras: int) -> NDArray[np.intp]:
    """How many of a person's pairs (M, 2) each of a pair's two cameras is in (M, 2): its noise counts that often."""
    key = owner[:, None] * cameras + pairs
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    return np.asarray(count[inverse].reshape(key.shape), dtype=np.intp)
