"""Which measurement belongs to which track: gates by chi-square, then the cheapest one-to-one assignment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import chdtri

from visfuse_cli.maths import gaussian
from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.records import Array, Gaussian

Indices = NDArray[np.intp]


def distances(expected: Gaussian, measured: Gaussian, angles: tuple[int, ...] = ()) -> Array:
    """Squared Mahalanobis distances (n, m) of m measurements (m, d) from n expected ones (n, d).

    expected.cov is H P H^T of each track, measured.cov the R of each measurement; components listed in `angles` wrap.
    Raises LinAlgError where a sum of the two is not positive definite.
    """
    if not len(expected.mean) or not len(measured.mean):
        return np.zeros((len(expected.mean), len(measured.mean)))
    residual = wrap_at(measured.mean[None] - expected.mean[:, None], angles)
    return gaussian.mahalanobis(residual, expected.cov[:, None] + measured.cov[None])


def gate(squared: Array, dof: int, probability: float = 0.999) -> Array:
    """Squared distances (...) with those outside the gate set to infinity; true pairs pass with `probability`."""
    return np.where(squared <= gate_size(dof, probability), squared, np.inf)


def gate_size(dof: int, probability: float) -> float:
    """The chi-square quantile: the squared distance below which a true pair of `dof` dimensions falls."""
    return float(chdtri(dof, 1 - probability))


def assign(cost: Array, forbidden: float = np.inf) -> tuple[Indices, Indices, Indices]:
    """Match rows to columns one to one: pairs (k, 2), unmatched rows, unmatched columns, all sorted.

    cost (n, m); cells at or above `forbidden`, infinite or NaN are never matched. Among the assignments with the most
    allowed pairs the cheapest is returned.
    """
    cost = np.asarray(cost, dtype=float)
    rows, columns = cost.shape
    allowed = np.isfinite(cost) & (cost < forbidden)
    pairs = np.empty((0, 2), dtype=np.intp)
    if allowed.any():
        shifted = np.where(allowed, cost - cost[allowed].min(), 0.0)
        # One forbidden cell costs more than any full set of allowed ones, so it is taken only where none is left.
        barrier = (shifted.max() + 1.0) * (min(rows, columns) + 1)
        i, j = linear_sum_assignment(np.where(allowed, shifted, barrier))
        pairs = np.column_stack([i, j])[allowed[i, j]]
    free = np.ones(rows, dtype=bool), np.ones(columns, dtype=bool)
    free[0][pairs[:, 0]] = free[1][pairs[:, 1]] = False
    return pairs, np.flatnonzero(free[0]), np.flatnonzero(free[1])
