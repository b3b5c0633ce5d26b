"""Joint probabilistic data association: where tracks cross, every measurement counts by how likely it is whose.

Fortmann, Bar-Shalom and Scheffe 1983. A joint event gives each track one measurement of its own or none; an event's
weight is the product of its pairs' likelihood ratios p_d p(z|track) / ((1 - p_d) clutter density).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import connected_components

from visfuse_cli.maths import gaussian
from visfuse_cli.maths.assignment import Indices
from visfuse_cli.records import Array, Gaussian

EXACT = 10  # measurements in one knot of tracks up to which all joint events are summed
ROUNDS, SETTLED = 200, 1e-9  # of the messages in larger knots


def probabilities(log_likelihood: Array, p_detect: float, clutter: float) -> Array:
    """Probabilities (n, m + 1) that a track's measurement is the j-th; the last column: that it has none.

    log_likelihood (n, m) of each measurement under each track, -inf outside of its gate; p_detect in (0, 1); clutter,
    the density of false measurements in the measurements' own space, above 0.
    """
    odds = np.exp(log_likelihood + np.log(p_detect / (1 - p_detect)) - np.log(clutter))
    n, m = odds.shape
    found = np.zeros((n, m + 1))
    for tracks, seen in _knots(odds > 0):
        part = odds[np.ix_(tracks, seen)]
        shared = _summed(part) if len(seen) <= EXACT else _passed(part)
        found[np.ix_(tracks, seen)] = shared
    found[:, m] = 1 - found[:, :m].sum(axis=1)
    return found


def update(belief: Gaussian, z: Array, H: Array, R: Array, share: Array) -> Gaussian:
    """Tracks (n, N) after measurements z (m, d), each by its share (n, m + 1) as of `probabilities`.

    H (d, N) or (n, 1, d, N), R (d, d) or (m, d, d). The mixture of all that may have been is matched by one Gaussian.
    """
    prior = Gaussian(belief.mean[:, None], belief.cov[:, None])
    residual = z - (H @ prior.mean[..., None])[..., 0]
    each, _ = gaussian.update(prior, residual, H, R)
    means = np.concatenate([each.mean, prior.mean], axis=1)
    covs = np.concatenate([np.broadcast_to(each.cov, (*means[:, :-1].shape, means.shape[-1])), prior.cov], axis=1)
    with np.errstate(divide="ignore"):
        return gaussian.moment_match(means, covs, np.log(np.clip(share, 0, None)))


def _knots(possible: Array) -> list[tuple[Indices, Indices]]:
    """Tracks and measurements that hang together by possible pairs (n, m)."""
    n, m = possible.shape
    links = np.zeros((n + m, n + m), dtype=bool)
    links[:n, n:] = possible
    count, label = connected_components(links, directed=False)
    knots = [(np.flatnonzero(label[:n] == k), np.flatnonzero(label[n:] == k)) for k in range(count)]
    return [(tracks, seen) for tracks, seen in knots if len(tracks) and len(seen)]


def _summed(odds: Array) -> Array:
    """Shares (n, m) by summing all joint events: over sets of measurements that the tracks before, and after, took."""
    n, m = odds.shape
    sets = np.arange(2**m)
    before, after = np.zeros((n + 1, 2**m)), np.zeros((n + 1, 2**m))
    before[0, 0] = after[n, 0] = 1.0
    free = [sets[(sets >> j) & 1 == 0] for j in range(m)]
    for i in range(n):
        k = n - 1 - i
        before[i + 1], after[k] = before[i], after[k + 1]
        for j in range(m):
            before[i + 1, free[j] | 1 << j] += odds[i, j] * before[i, free[j]]
            after[k, free[j] | 1 << j] += odds[k, j] * after[k + 1, free[j]]
        before[i + 1] /= before[i + 1].sum()
        after[k] /= after[k].sum()
    full = 2**m - 1
    shares = np.empty((n, m))
    for i in range(n):
        rest = _subsets(after[i + 1])  # weight of all that the later tracks take within a set
        none = before[i] @ rest[full ^ sets]
        taken = [odds[i, j] * (before[i, free[j]] @ rest[full ^ free[j] ^ 1 << j]) for j in range(m)]
        shares[i] = np.array(taken) / (none + sum(taken))
    return shares


def _subsets(weights: Array) -> Array:
    """Sums (2^m,) of the weights of all subsets of each set."""
    total = weights.copy()
    for j in range(int(np.log2(len(weights)))):
        part = total.reshape(-1, 2, 1 << j)
        part[:, 1] += part[:, 0]
    return total


def _passed(odds: Array) -> Array:
    """Shares (n, m) by messages to and fro, close to the sum where knots are large (Williams and Lau 2014)."""
    to_track = np.ones_like(odds)
    for _ in range(ROUNDS):
        said = odds * to_track
        to_seen = odds / (1 + said.sum(axis=1, keepdims=True) - said)
        new = 1 / (1 + to_seen.sum(axis=0) - to_seen)
        change, to_track = np.abs(new - to_track).max(), new
        if change < SETTLED:
            break
    said = odds * to_track
    return np.asarray(said / (1 + said.sum(axis=1, keepdims=True)))
