"""Lens distortion in and out; the undistorted camera keeps K."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Lens

POLISH = 20


def undistort_points(points: Array, lens: Lens) -> Array:
    """Pixels (N, 2) of the footage to pixels (N, 2) of a camera with the same K and no distortion."""
    shaped = np.ascontiguousarray(points, dtype=float).reshape(-1, 1, 2)
    straight = np.asarray(cv2.undistortPoints(shaped, lens.K, lens.D, None, None, lens.K), dtype=float).reshape(-1, 2)
    for _ in range(POLISH):  # OpenCV stops after five rounds; strong lenses want more
        straight = straight - (distort_points(straight, lens) - points)
    return straight


def distort_points(points: Array, lens: Lens) -> Array:
    """Pixels (N, 2) of the camera without distortion to pixels (N, 2) of the footage."""
    rays = np.linalg.solve(lens.K, np.column_stack([points, np.ones(len(points))]).T).T
    pixels, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), lens.K, lens.D)
    return np.asarray(pixels, dtype=float).reshape(-1, 2)
