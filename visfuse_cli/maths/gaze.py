"""Pan-tilt angles to the frontal plane: the plane at unit distance before the resting gaze (Bradshaw 1997, sec. 3)."""

from __future__ import annotations

import numpy as np

from visfuse_cli.records import Array

ORDERS = ("elevation-vergence", "vergence-elevation")


def frontal(elevation: Array, vergence: Array, order: str = ORDERS[0]) -> Array:
    """Frontal-plane point (N, 2), first axis left, second up, from elevation (up) and vergence (left), (N,) rad each.

    order: which axis is outside; with elevation outside the point is (tan v / cos e, tan e, 1), with vergence outside
    (tan v, tan e / cos v, 1). The image's axes u and v point the other way. Bradshaw 1997, sec. 3, corrected.
    """
    if order == "elevation-vergence":
        return np.column_stack([np.tan(vergence) / np.cos(elevation), np.tan(elevation)])
    return np.column_stack([np.tan(vergence), np.tan(elevation) / np.cos(vergence)])


def angles(points: Array, order: str = ORDERS[0]) -> tuple[Array, Array]:
    """Elevation and vergence (N,) rad that look at frontal points (N, 2); the inverse of `frontal`."""
    left, up = points[:, 0], points[:, 1]
    if order == "elevation-vergence":
        elevation = np.arctan(up)
        return elevation, np.arctan(left * np.cos(elevation))
    vergence = np.arctan(left)
    return np.arctan(up * np.cos(vergence)), vergence
