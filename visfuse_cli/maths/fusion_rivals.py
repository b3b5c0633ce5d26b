"""Fusion without feedback, for comparison: convex combination, Kim's track-to-track fusion, covariance intersection.

Here every pair of cameras keeps a Kalman filter of its own, and nothing flows back into it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.fusion import position
from visfuse_cli.maths.gaussian import inverse, symmetrise, times, transpose
from visfuse_cli.maths.multiview import project
from visfuse_cli.records import Array, Gaussian

ROUNDS = 40  # of the weights of covariance intersection
NEGLIGIBLE = 1e-4  # of the largest eigenvalue: with shared cameras some directions hold rounding and no noise


@dataclass(frozen=True, slots=True)
class Bank:
    """The local filters of one person: pairs (N, 2) of cameras, mean (N, n), and the joint covariance (N, n, N, n).

    The covariance between two filters comes from the motion's noise, which is one for all, and from shared cameras.
    """

    pairs: tuple[tuple[int, int], ...]
    mean: Array
    joint: Array

    @property
    def local(self) -> Gaussian:
        """The local beliefs (N, n)."""
        index = np.arange(len(self.pairs))
        return Gaussian(self.mean, self.joint[index, :, index, :])


def started(belief: Gaussian, pairs: tuple[tuple[int, int], ...]) -> Bank:
    """A bank whose filters all begin with the same belief (n,)."""
    count = len(pairs)
    size = len(belief.mean)
    joint = np.broadcast_to(belief.cov[None, :, None, :], (count, size, count, size)).copy()
    return Bank(pairs, np.tile(belief.mean, (count, 1)), joint)


def predicted(bank: Bank, F: Array, Q: Array) -> Bank:
    """Every filter one step ahead, F and Q (n, n); the same noise strikes all. Wu 2010, eq. 6."""
    joint = np.einsum("ab,ibjc,dc->iajd", F, bank.joint, F) + Q[None, :, None, :]
    return Bank(bank.pairs, bank.mean @ F.T, joint)


def updated(bank: Bank, rows: NDArray[np.intp], y: Array, noise: Array) -> Bank:
    """Filters `rows` (M,) after their measurements y (M, 3), noise (M, M, 3, 3) between them. Wu 2010, eqs. 4-5."""
    count, size = bank.mean.shape
    prior = bank.local
    own = np.arange(len(rows))
    S = symmetrise(prior.cov[rows][:, :3, :3] + noise[own, own])
    gain = np.zeros((count, size, 3))
    gain[rows] = transpose(np.linalg.solve(S, prior.cov[rows][:, :3]))
    mean = bank.mean.copy()
    mean[rows] += times(gain[rows], y - bank.mean[rows, :3])
    keep = np.eye(size) - gain @ position(size)
    joint = np.einsum("iab,ibjc,jdc->iajd", keep, bank.joint, keep)
    every = np.arange(size)
    joint[np.ix_(rows, every, rows, every)] += np.einsum("iab,ijbc,jdc->iajd", gain[rows], noise, gain[rows])
    return Bank(bank.pairs, mean, joint)


def pair_noise(P: Array, R: Array, pairs: NDArray[np.intp], point: Array, cov: Array) -> Array:
    """Covariances (M, M, 3, 3) of the pairs' triangulated points (M, 3), those that share a camera included.

    P (K, 3, 4) and R (K, 2, 2) px^2 by camera, pairs (M, 2) of cameras, cov (M, 3, 3) of each point alone.
    """
    _, J = project(P[pairs], point[:, None, :])
    weight = inverse(R)
    gains = np.zeros((len(pairs), len(P), 3, 2))  # of each pair's point to each camera's pixels
    gains[np.arange(len(pairs))[:, None], pairs] = cov[:, None] @ transpose(J) @ weight[pairs]
    return np.asarray(np.einsum("ikab,kbc,jkdc->ijad", gains, R, gains))


def naive(bank: Bank) -> Gaussian:
    """Convex combination as if the local estimates (N, n) were independent ("Austere"): (n,)."""
    local = bank.local
    information = inverse(local.cov)
    cov = inverse(information.sum(axis=0))
    return Gaussian(cov @ times(information, local.mean).sum(axis=0), cov)


def kim(bank: Bank) -> Gaussian:
    """The most likely state (n,) given all local estimates and what correlates them (Kim 1994)."""
    sigma = symmetrise(bank.joint.reshape(bank.mean.size, bank.mean.size))
    scale = np.sqrt(np.diagonal(sigma))
    values, vectors = np.linalg.eigh(sigma / np.outer(scale, scale))
    used = values > NEGLIGIBLE * values[-1]
    # Directions without noise repeat what others say, so that they are left out and not divided by.
    half = (vectors[:, used] / np.sqrt(values[used])).T / scale
    E = half @ np.tile(np.eye(bank.mean.shape[1]), (len(bank.pairs), 1))
    cov = inverse(E.T @ E)
    return Gaussian(cov @ (E.T @ (half @ bank.mean.ravel())), cov)


def covariance_intersection(bank: Bank) -> Gaussian:
    """The convex combination (n,) with the smallest determinant that holds for any correlation of the local estimates.

    The weights maximise log det of the combined information by the multiplicative rounds of optimal design.
    """
    local = bank.local
    information = inverse(local.cov)
    weights = np.full(len(bank.pairs), 1 / len(bank.pairs))
    for _ in range(ROUNDS):
        cov = inverse(np.einsum("i,iab->ab", weights, information))
        weights = weights * np.einsum("ab,iba->i", cov, information) / len(cov)
    cov = inverse(np.einsum("i,iab->ab", weights, information))
    return Gaussian(cov @ np.einsum("i,iab,ib->a", weights, information, local.mean), cov)
