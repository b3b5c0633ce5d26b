"""The upright person as three level rings (feet, shoulders, head): what box it fills in a picture."""

from __future__ import annotations

import numpy as np

from visfuse_cli.maths.multiview import project
from visfuse_cli.records import Array

RINGS = ((0.0, 0.45), (0.45, 0.8), (0.8, 1.0), (1.0, 0.3))  # share of the height, share of half the width
AROUND = np.linspace(0, 2 * np.pi, 8, endpoint=False)
CIRCLE = np.column_stack([np.cos(AROUND), np.sin(AROUND)])


def outline(foot: Array, height: Array, width: Array) -> Array:
    """Points (..., 32, 3) m on the surface of people whose feet stand at (..., 3), height and width (...) m."""
    share = np.array(RINGS)
    radius = share[:, 1] * np.asarray(width)[..., None] / 2  # (..., rings)
    level = share[:, 0] * np.asarray(height)[..., None]
    ring = radius[..., None, None] * CIRCLE
    up = np.broadcast_to(level[..., None, None], (*ring.shape[:-1], 1))
    points = np.concatenate([ring, up], axis=-1) + foot[..., None, None, :]
    return points.reshape(*points.shape[:-3], points.shape[-3] * points.shape[-2], 3)


def boxes(P: Array, points: Array) -> Array:
    """Boxes [u0, v0, u1, v1] (..., 4) px around surfaces (..., n, 3) under cameras (..., 3, 4); NaN behind them."""
    pixels, _ = project(P[..., None, :, :], points)
    return np.concatenate([pixels.min(axis=-2), pixels.max(axis=-2)], axis=-1)
