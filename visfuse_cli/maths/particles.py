"""The core of a particle filter: log weights, effective number, systematic resampling, moments, backward draws."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, Gaussian


def normalised(log_weights: Array) -> Array:
    """Log weights (P,) whose exponentials sum to one; raises ValueError where none is finite."""
    top = float(np.max(log_weights))
    if not np.isfinite(top):
        raise ValueError("no particle has a weight")
    return np.asarray(log_weights - top - np.log(np.sum(np.exp(log_weights - top))))


def effective_number(log_weights: Array) -> float:
    """How many particles of equal weight say as much as these (P,), normalised: 1 / sum w^2."""
    return float(np.exp(-_log_sum(2 * log_weights)))


def _log_sum(values: Array) -> float:
    top = float(np.max(values))
    return top + float(np.log(np.sum(np.exp(values - top))))


def systematic(log_weights: Array, rng: np.random.Generator, count: int | None = None) -> NDArray[np.intp]:
    """Indices of `count` draws from normalised log weights (P,), by one comb of equal teeth."""
    count = len(log_weights) if count is None else count
    edges = np.cumsum(np.exp(log_weights))
    teeth = (np.arange(count) + rng.random()) / count
    return np.minimum(np.searchsorted(edges, teeth * edges[-1]), len(log_weights) - 1)


def moments(states: Array, log_weights: Array) -> Gaussian:
    """Mean (n,) and covariance (n, n) of states (P, n) under normalised log weights (P,)."""
    weights = np.exp(log_weights)
    mean = weights @ states
    off = states - mean
    return Gaussian(mean, (weights[:, None] * off).T @ off)


def regularised(states: Array, log_weights: Array, rng: np.random.Generator, share: float = 1.0) -> Array:
    """States (P, n) jittered by a Gaussian kernel of the optimal width, shrunk so that mean and covariance stay."""
    count, size = states.shape
    width = share * (4 / (size + 2)) ** (1 / (size + 4)) * count ** (-1 / (size + 4))
    belief = moments(states, log_weights)
    values, vectors = np.linalg.eigh(belief.cov)
    half = vectors * np.sqrt(np.clip(values, 0, None))
    shrink = 1 / np.sqrt(1 + width**2)
    jittered = belief.mean + shrink * (states - belief.mean + width * rng.normal(size=states.shape) @ half.T)
    return np.asarray(jittered)
