"""The core of a particle filter: log weights, effective number, systematic resampling, moments, backward draws.

Clouds are states (..., P, n) under normalised log weights (..., P); leading axes are tracks.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.gaussian import log_density, symmetrise, transpose
from visfuse_cli.records import Array, Gaussian

LogLikelihood = Callable[[Array], Array]  # log p(z | x) of states (P, n): (P,)
HALVINGS = 24  # of a likelihood's share
WIDER = 1.2  # than the proposal's covariance, that states are drawn from
# log p(x_k+1 | x_k) of states now (P, n) and the next ones (M, n), k the instant now: (P, M)
LogTransition = Callable[[Array, Array, int], Array]


def normalised(log_weights: Array) -> Array:
    """Log weights (..., P) whose exponentials sum to one; raises ValueError where a cloud has no finite one."""
    top = np.max(log_weights, axis=-1, keepdims=True)
    if not np.isfinite(top).all():
        raise ValueError("no particle has a weight")
    total = np.sum(np.exp(log_weights - top), axis=-1, keepdims=True)
    return np.asarray(log_weights - top - np.log(total))


def effective_number(log_weights: Array) -> Array:
    """How many particles of equal weight say as much (...) as these (..., P): 1 / sum w^2."""
    return np.asarray(1 / np.sum(np.exp(2 * log_weights), axis=-1))


def systematic(log_weights: Array, rng: np.random.Generator, count: int | None = None) -> NDArray[np.intp]:
    """Indices (..., count) of draws from each cloud's weights (..., P), by one comb of equal teeth."""
    size = log_weights.shape[-1]
    count = size if count is None else count
    edges = np.cumsum(np.exp(log_weights), axis=-1).reshape(-1, size)
    cloud = np.arange(len(edges))[:, None]  # each cloud's edges lie in its own unit interval: one search for all
    teeth = (np.arange(count) + rng.random((len(edges), 1))) / count
    found = np.searchsorted((edges / edges[:, -1:] + cloud).ravel(), (teeth + cloud).ravel())
    index = np.clip(found.reshape(-1, count) - size * cloud, 0, size - 1)
    return index.reshape(*log_weights.shape[:-1], count)


def moments(states: Array, log_weights: Array) -> Gaussian:
    """Mean (..., n) and covariance (..., n, n) of the clouds."""
    weights = np.exp(log_weights)
    mean = (weights[..., None, :] @ states)[..., 0, :]
    off = states - mean[..., None, :]
    return Gaussian(mean, symmetrise(transpose(weights[..., None] * off) @ off))


def regularised(states: Array, log_weights: Array, rng: np.random.Generator, share: float = 1.0) -> Array:
    """States (..., P, n) jittered by a Gaussian kernel of `share` times the optimal width; the moments stay."""
    count, size = states.shape[-2:]
    width = share * (4 / (size + 2)) ** (1 / (size + 4)) * count ** (-1 / (size + 4))
    belief = moments(states, log_weights)
    values, vectors = np.linalg.eigh(belief.cov)
    half = vectors * np.sqrt(np.clip(values, 0, None))[..., None, :]
    shrink = 1 / np.sqrt(1 + width**2)
    centre = belief.mean[..., None, :]
    kick = width * rng.normal(size=states.shape) @ transpose(half)
    return np.asarray(centre + shrink * (states - centre + kick))


def renewed(
    states: Array, log_weights: Array, rng: np.random.Generator, least: float = 0.5, jitter: float = 0.0
) -> tuple[Array, Array]:
    """The clouds, those drawn anew whose effective number fell below `least` of P; `jitter` as in `regularised`."""
    low = effective_number(log_weights) < least * log_weights.shape[-1]
    if not np.any(low):
        return states, log_weights
    index = np.where(low[..., None], systematic(log_weights, rng), np.arange(log_weights.shape[-1]))
    after = np.where(low[..., None], -np.log(log_weights.shape[-1]), log_weights)
    drawn = np.take_along_axis(states, index[..., None], axis=-2)
    if jitter:
        drawn = np.where(low[..., None, None], regularised(drawn, after, rng, jitter), drawn)
    return drawn, after


def bearable(log_weights: Array, log_likelihood: Array, least: float) -> float:
    """The largest share of a log likelihood (P,), at most 1, that leaves one cloud an effective number of `least` P."""
    low, high, middle = 0.0, 1.0, 1.0
    for _ in range(HALVINGS):
        enough = effective_number(normalised(log_weights + middle * log_likelihood)) >= least * len(log_weights)
        low, high = (middle, high) if enough else (low, middle)
        if low == high:
            break
        middle = (low + high) / 2
    return low


def drawn(belief: Gaussian, count: int, rng: np.random.Generator) -> Array:
    """States (count, n), more than n, whose mean and covariance are the belief's to rounding."""
    kick = rng.normal(size=(count, len(belief.mean)))
    kick -= kick.mean(axis=0)
    white = np.linalg.solve(np.linalg.cholesky(kick.T @ kick / count), kick.T)
    return np.asarray(belief.mean + (np.linalg.cholesky(belief.cov) @ white).T)


def imported(
    prior: Gaussian, proposal: Gaussian, log_likelihood: LogLikelihood, count: int, rng: np.random.Generator
) -> tuple[Array, Array, float]:
    """A cloud (count, n) of the posterior, its log weights, and the log evidence: drawn from `proposal`, weighed.

    For a measurement far sharper than the prior, of which hardly a particle would be left otherwise: the Gaussian
    particle filter of Kotecha & Djuric 2003.
    """
    wide = WIDER * proposal.cov
    states = drawn(Gaussian(proposal.mean, wide), count, rng)
    weights = log_likelihood(states) + log_density(states - prior.mean, prior.cov)
    weights = weights - log_density(states - proposal.mean, wide)
    log_weights = normalised(weights)
    return states, log_weights, float(np.max(weights - log_weights) - np.log(count))


def backward_draws(
    states: Array, log_weights: Array, log_transition: LogTransition, rng: np.random.Generator, count: int
) -> Array:
    """Whole ways (T, count, n) drawn given all measurements: a fixed-interval smoother by backward simulation.

    states (T, P, n) and log_weights (T, P) are one filter's clouds after each measurement, before any are drawn anew;
    the motion must have a density, so that each way's next state weighs the particles of now.
    """
    ways = np.empty((len(states), count, states.shape[-1]))
    ways[-1] = states[-1, systematic(log_weights[-1], rng, count)]
    for k in range(len(states) - 2, -1, -1):
        share = normalised((log_weights[k][:, None] + log_transition(states[k], ways[k + 1], k)).T)
        ways[k] = states[k, systematic(share, rng, 1)[:, 0]]
    return ways
