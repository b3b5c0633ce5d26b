"""Lens distortion in and out; the undistorted camera keeps K."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Lens

ROUNDS = 30
SETTLED = 1e-9  # px


def undistort_points(points: Array, lens: Lens) -> Array:
    """Pixels (N, 2) of the footage to pixels (N, 2) of a camera with the same K and no distortion.

    Where no pixel distorts to a point (beyond the lens model's turning point) the nearest found stands for it.
    """
    # Newton, halved where it would overshoot: OpenCV's fixed-point rounds diverge under strong pincushion distortion
    rays = _rays(points, lens)
    seen, slope = _project(rays, lens)
    off, share = seen - points, np.ones(len(rays))
    for _ in range(ROUNDS):
        error = np.linalg.norm(off, axis=1)
        if not np.any(error > SETTLED):
            break
        tried = rays - share[:, None] * _solved(slope, off)
        seen, tried_slope = _project(tried, lens)
        better = np.linalg.norm(seen - points, axis=1) < error
        rays, off = np.where(better[:, None], tried, rays), np.where(better[:, None], seen - points, off)
        slope = np.where(better[:, None, None], tried_slope, slope)
        share = np.where(better, 1.0, share / 2)
    return np.asarray(rays @ lens.K[:2, :2].T + lens.K[:2, 2], dtype=float)


def distort_points(points: Array, lens: Lens) -> Array:
    """Pixels (N, 2) of the camera without distortion to pixels (N, 2) of the footage."""
    return _project(_rays(points, lens), lens)[0]


def _rays(points: Array, lens: Lens) -> Array:
    """Ray directions (N, 2) at unit depth through undistorted pixels (N, 2)."""
    return np.asarray(
        np.linalg.solve(lens.K[:2, :2], (np.asarray(points, dtype=float) - lens.K[:2, 2]).T).T, dtype=float
    )


def _project(rays: Array, lens: Lens) -> tuple[Array, Array]:
    """Pixels (N, 2) of the footage that see rays (N, 2), and d pixel / d ray (N, 2, 2)."""
    if not len(rays):
        return np.empty((0, 2)), np.empty((0, 2, 2))
    at_unit_depth = np.column_stack([rays, np.ones(len(rays))]).reshape(-1, 1, 3)
    pixels, derivatives = cv2.projectPoints(at_unit_depth, np.zeros(3), np.zeros(3), lens.K, lens.D)
    by_shift = np.asarray(derivatives, dtype=float)[:, 3:5]  # columns: rotation, shift, ...
    return np.asarray(pixels, dtype=float).reshape(-1, 2), by_shift.reshape(-1, 2, 2)


def _solved(slope: Array, off: Array) -> Array:
    """Solutions (N, 2) of slope (N, 2, 2) x = off (N, 2); 0 where the slope is singular."""
    (a, b), (c, d) = slope.transpose(1, 2, 0)
    area = a * d - b * c
    x = np.column_stack([d * off[:, 0] - b * off[:, 1], a * off[:, 1] - c * off[:, 0]])
    return np.divide(x, area[:, None], out=np.zeros_like(x), where=area[:, None] != 0)
