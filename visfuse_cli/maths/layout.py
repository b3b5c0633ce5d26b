"""Where marks lie on a plane, from what is known of them: a repeating pattern, or distances measured between them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from visfuse_cli.errors import InputError
from visfuse_cli.records import Array

STARTS = 60  # a layout folds in many ways; each start finds one
AS_GOOD = 1e-3  # of the longest distance: layouts this close to the best one are weighed by the picture
CLEAR = 0.02  # of the largest triangle: smaller ones do not tell which way round they are


def dashes(lines: NDArray[np.intp], width: float, period: float, dash: float = 0.0) -> Array:
    """Ends of lane dashes (n, 2) m, from near to far along each line: X = line * width, Y by its place in the line.

    `lines` (n,) says which line each end is on. With `dash` both ends of every dash were taken, near one first;
    else one end of each, `period` apart.
    """
    world = np.empty((len(lines), 2))
    for line in np.unique(lines):
        place = np.arange(np.count_nonzero(lines == line))
        along = place // 2 * period + place % 2 * dash if dash else place * period
        world[lines == line] = np.column_stack([np.full(len(place), line * width), along])
    return world


def rectangle(width: float, length: float) -> Array:
    """Corners (4, 2) m of a rectangle: near left, near right, far right, far left."""
    return np.array([[0.0, 0.0], [width, 0.0], [width, length], [0.0, length]])


def from_distances(pairs: NDArray[np.intp], distances: Array, image: Array) -> tuple[Array, Array]:
    """Points (n, 2) m with the given distances (m,) between pairs (m, 2) of them, and how far (m,) each is missed.

    The first point is the origin, the second lies on +Y. Of the ways to fold them, the picture (n, 2) px chooses: seen
    from above, no three visible points change their sense of rotation. Raises InputError where points stay free.
    """
    n = len(image)
    if len(pairs) < 2 * n - 3:
        raise InputError(f"{n} points need {2 * n - 3} distances or more between them, not {len(pairs)}")
    triples = np.array([(a, b, c) for a in range(n) for b in range(a) for c in range(b)])
    seen = _turns(image * [1, -1], triples)  # v points down
    best: tuple[int, float, Array] | None = None
    found = _foldings(n, tuple(map(tuple, pairs.tolist())), tuple(distances.tolist()))
    least = min(worst for worst, _ in found)
    for worst, points in found:
        if worst > least + AS_GOOD * distances.max():
            continue
        for mirrored in (points, points * [-1, 1]):
            against = int(np.sum(seen * _turns(mirrored, triples) < 0))
            if best is None or (against, worst) < best[:2]:
                best = (against, worst, mirrored)
    assert best is not None
    points = _standing(best[2])
    if np.linalg.matrix_rank(_rigidity(points, pairs), tol=1e-6 * distances.max()) < 2 * n - 3:
        raise InputError("these distances leave some points free to move; measure more of them, crosswise")
    if best[0]:
        raise InputError("no layout with these distances looks like the picture; check the numbers of the points")
    return points, _lengths(points, pairs) - distances


@lru_cache(maxsize=8)  # while a mark is dragged in the picture the distances stay
def _foldings(
    n: int, pairs: tuple[tuple[int, int], ...], distances: tuple[float, ...]
) -> tuple[tuple[float, Array], ...]:
    """Layouts (n, 2) m that suit the distances, from random starts, each with its worst distance's miss (m)."""
    ends, lengths = np.array(pairs), np.array(distances)
    found = []

    def missed(flat: Array) -> Array:
        return _lengths(flat.reshape(n, 2), ends) - lengths

    for seed in range(STARTS):
        start = np.random.default_rng(seed).normal(size=2 * n) * lengths.max() / 2
        solved = least_squares(missed, start, max_nfev=200)
        points = solved.x.reshape(n, 2)
        found.append((float(np.abs(_lengths(points, ends) - lengths).max()), points))
    return tuple(found)


def _lengths(points: Array, pairs: NDArray[np.intp]) -> Array:
    return np.asarray(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1))


def _rigidity(points: Array, pairs: NDArray[np.intp]) -> Array:
    """d length^2 / d points / 2 (m, 2 n): its rank tells whether anything may still move."""
    rows = np.zeros((len(pairs), len(points), 2))
    apart = points[pairs[:, 0]] - points[pairs[:, 1]]
    rows[np.arange(len(pairs)), pairs[:, 0]], rows[np.arange(len(pairs)), pairs[:, 1]] = apart, -apart
    return rows.reshape(len(pairs), -1)


def _turns(points: Array, triples: NDArray[np.intp]) -> Array:
    """Sense of rotation of triples of points (n, 2): 1, -1, or 0 where they are nearly on a line."""
    a, b, c = (points[triples[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    return np.asarray(np.where(np.abs(area) > CLEAR * np.abs(area).max(), np.sign(area), 0.0))


def _standing(points: Array) -> Array:
    """The same layout with its first point at the origin and its second on +Y."""
    points = points - points[0]
    up = points[1] / np.linalg.norm(points[1])
    return points @ np.array([[up[1], up[0]], [-up[0], up[1]]])
