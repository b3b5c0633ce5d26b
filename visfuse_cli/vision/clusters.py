"""K-means over flow, place and colour: which pixels that move are of one thing (Jia 2008, sec. 2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array

WEIGHTS = np.array([1.0, 1, 1, 1, 2, 2, 2])  # of [vx, vy, x, y, R, G, B]: Jia 2008, eq. 2
ROUNDS = 30
APART = 0.25  # validity ratio of clusters that stand apart


def whitened(features: Array, weights: Array = WEIGHTS) -> Array:
    """Features (n, 7) in which Euclidean distance is the paper's weighted Mahalanobis one. Jia 2008, eq. 1.

    d = dx^T W^1/2 S^-1 W^1/2 dx with S of the unweighted features: those of the weighted ones would cancel W.
    """
    S = np.cov(features, rowvar=False)
    S += np.diag(1e-3 * np.diag(S) + 1e-9)  # grey footage tells one brightness three times
    L = np.linalg.cholesky(np.linalg.inv(S))
    return np.asarray((features * np.sqrt(weights)) @ L)


def kmeans(points: Array, centres: Array) -> tuple[NDArray[np.intp], Array]:
    """Labels (n,) and centres (k, d) of plain K-means from given centres (k, d); an empty cluster keeps its centre."""
    labels = np.zeros(len(points), dtype=np.intp)
    for turn in range(ROUNDS):
        fresh = np.argmin(
            np.sum(points**2, axis=1)[:, None] - 2 * points @ centres.T + np.sum(centres**2, axis=1), axis=1
        )
        if turn and np.array_equal(fresh, labels):
            break
        labels = fresh
        count = np.bincount(labels, minlength=len(centres))
        sums = np.stack(
            [np.bincount(labels, points[:, d], minlength=len(centres)) for d in range(points.shape[1])], axis=1
        )
        centres = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], centres)
    return labels, centres


def segmented(points: Array, most: int, count: int | None, warm: Array | None = None) -> NDArray[np.intp]:
    """Labels (n,) of points (n, d) in `count` clusters, or in as many as the validity ratio asks for, up to `most`.

    Ray and Turi: the mean squared distance within clusters over the least one between their centres. One cluster is
    kept where two or more do not stand well apart. From `warm` centres (k, d) of the frame before no other number is
    tried as long as these still stand apart.
    """
    if warm is not None and len(warm) > 1 and len(points) >= 8 * len(warm) and count in (None, len(warm)):
        labels, ratio = _tried(points, warm)
        if ratio < APART:
            return labels
    best, labels = APART, np.zeros(len(points), dtype=np.intp)
    for k in [count] if count is not None else range(2, most + 1):
        if len(points) < 8 * k:
            break
        found, ratio = _tried(points, _spread(points, k))
        if count is not None or ratio < best:
            best, labels = ratio, found
    return labels


def _tried(points: Array, centres: Array) -> tuple[NDArray[np.intp], float]:
    """Labels (n,) of K-means from those centres (k, d), and the validity ratio."""
    labels, centres = kmeans(points, centres)
    within = float(np.mean(np.sum((points - centres[labels]) ** 2, axis=1)))
    between = np.sum((centres[:, None] - centres[None]) ** 2, axis=-1)[np.triu_indices(len(centres), 1)]
    return labels, within / max(float(between.min()), 1e-12) if len(centres) > 1 else 0.0


def _spread(points: Array, k: int) -> Array:
    """k starting centres (k, d), each the farthest from those before: the same every time."""
    chosen = [int(np.argmax(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))]
    near = np.sum((points - points[chosen[0]]) ** 2, axis=1)
    while len(chosen) < k:
        chosen.append(int(np.argmax(near)))
        near = np.minimum(near, np.sum((points - points[chosen[-1]]) ** 2, axis=1))
    return points[chosen].copy()
