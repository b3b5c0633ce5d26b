"""Polygons on a plane: what lies inside of one, and how far away the rest is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array

Polygon = tuple[tuple[float, float], ...]  # corners on the ground, m
LEAST_AREA = 0.01  # m^2


def surrounding(polygon: Polygon, name: str) -> Polygon:
    """The polygon itself; raises ValueError, calling it by its name, where it surrounds nothing."""
    if len(polygon) < 3:
        raise ValueError(f"{name} has {len(polygon)} corners; a polygon needs three or more")
    if area(np.array(polygon)) < LEAST_AREA:
        raise ValueError(f"{name} surrounds no ground; its corners lie on one line")
    return polygon


def contains(polygon: Array, points: Array) -> NDArray[np.bool_]:
    """Which points (..., 2) lie inside a polygon (k, 2), crossing edges counted; it may be concave."""
    x, y = polygon.T
    x2, y2 = np.roll(x, -1), np.roll(y, -1)
    at = points[..., None, :]
    crosses = (y > at[..., 1]) != (y2 > at[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        left = at[..., 0] < (x2 - x) * (at[..., 1] - y) / (y2 - y) + x
    return np.asarray(np.sum(crosses & left, axis=-1) % 2 == 1)


def distance(polygon: Array, points: Array) -> Array:
    """Distances (...,) of points (..., 2) from the border of a polygon (k, 2)."""
    along = np.roll(polygon, -1, axis=0) - polygon
    offset = points[..., None, :] - polygon
    length = np.maximum(np.sum(along**2, axis=-1), 1e-12)
    share = np.clip(np.sum(offset * along, axis=-1) / length, 0, 1)
    return np.asarray(np.linalg.norm(offset - share[..., None] * along, axis=-1).min(axis=-1))


def area(polygon: Array) -> float:
    """The area of a polygon (k, 2), never negative."""
    x, y = polygon.T
    return float(abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2)
