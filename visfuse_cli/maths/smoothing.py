"""The backward pass over a finished track: every state given the whole recording, and what correlates them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.maths.gaussian import symmetrise, times, transpose
from visfuse_cli.records import Array, Gaussian


@dataclass(frozen=True, slots=True)
class Smoothed(Gaussian):
    """Smoothed beliefs (T, ..., n) with the gains (T-1, ..., n, n): cov(x_k, x_k+1) = gain_k cov_k+1."""

    gains: Array


def rauch_tung_striebel(filtered: Gaussian, predicted: Gaussian, F: Array, angles: tuple[int, ...] = ()) -> Smoothed:
    """Fixed-interval smoother, for linear and extended filters, with fading or without.

    filtered (T, ..., n) after the measurements; predicted (T, ..., n) before them, predicted[k] from filtered[k-1] by
    F[k] (T, ..., n, n), its covariance as the filter used it (faded); predicted[0] and F[0] are not read. Components
    listed in `angles` are in rad and stay in (-pi, pi]. Where nothing was measured, filtered equals predicted.
    Raises LinAlgError where a predicted covariance is singular.
    """
    F_P = F[1:] @ filtered.cov[:-1]
    gains = transpose(np.linalg.solve(predicted.cov[1:], F_P))
    keep = np.eye(F.shape[-1]) - gains @ F[1:]
    noise = predicted.cov[1:] - F_P @ transpose(F[1:])
    # What the future cannot tell, as a sum of squares: no difference of covariances to go negative.
    own = keep @ filtered.cov[:-1] @ transpose(keep) + gains @ noise @ transpose(gains)
    mean, cov = filtered.mean.copy(), filtered.cov.copy()
    for k in range(len(mean) - 2, -1, -1):
        surprise = wrap_at(mean[k + 1] - predicted.mean[k + 1], angles)
        mean[k] = wrap_at(filtered.mean[k] + times(gains[k], surprise), angles)
        cov[k] = symmetrise(own[k] + gains[k] @ cov[k + 1] @ transpose(gains[k]))
    return Smoothed(mean, cov, gains)


def lag_one(smoothed: Smoothed) -> Array:
    """Covariances (T-1, ..., n, n) of each smoothed state with the next: cov(x_k, x_k+1)."""
    return smoothed.gains @ smoothed.cov[1:]


def cross_covariance(smoothed: Smoothed, i: int, j: int) -> Array:
    """cov(x_i, x_j) (..., n, n) of two smoothed states, 0 <= i, j < T."""
    if i > j:
        return transpose(cross_covariance(smoothed, j, i))
    product = smoothed.cov[j]
    for gain in smoothed.gains[i:j][::-1]:
        product = gain @ product
    return product


def cross_covariances(smoothed: Smoothed, indices: Sequence[int] | NDArray[np.intp]) -> Array:
    """cov(x_i, x_j) (m, m, ..., n, n) of every pair among m smoothed states, indices strictly rising."""
    bridges = [
        reduce(np.matmul, smoothed.gains[first:last])  # cov(x_first, x_last) = bridge P_last
        for first, last in itertools.pairwise(indices)
    ]
    pairs = np.empty((len(indices), len(indices), *smoothed.cov.shape[1:]))
    for b, last in enumerate(indices):
        pairs[b, b] = smoothed.cov[last]
        for a in range(b - 1, -1, -1):
            pairs[a, b] = bridges[a] @ pairs[a + 1, b]
            pairs[b, a] = transpose(pairs[a, b])
    return pairs


def weighted_variance(smoothed: Smoothed, weights: Array) -> Array:
    """Variance (...) of sum_k weights_k . x_k over a smoothed track, weights (T, ..., n), all correlations in it."""
    total = np.zeros(smoothed.mean.shape[1:-1])
    carried = np.zeros(smoothed.mean.shape[1:])  # what all earlier states together weigh in state k
    for k, weight in enumerate(weights):
        P_w = times(smoothed.cov[k], weight)
        total = total + np.sum((weight + 2 * carried) * P_w, axis=-1)
        if k < len(smoothed.gains):
            carried = times(transpose(smoothed.gains[k]), carried + weight)
    return total
