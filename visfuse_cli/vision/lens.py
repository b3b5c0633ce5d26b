"""Lens distortion in and out; the undistorted camera keeps K."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Lens


def undistort_points(points: Array, lens: Lens) -> Array:
    """Pixels (N, 2) of the footage to pixels (N, 2) of a camera with the same K and no distortion."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    shaped = np.ascontiguousarray(points, dtype=float).reshape(-1, 1, 2)
    return np.asarray(cv2.undistortPointsIter(shaped, lens.K, lens.D, np.eye(3), lens.K, criteria)).reshape(-1, 2)


def distort_points(points: Array, lens: Lens) -> Array:
    """Pixels (N, 2) of the camera without distortion to pixels (N, 2) of the footage."""
    rays = np.linalg.solve(lens.K, np.column_stack([points, np.ones(len(points))]).T).T
    pixels, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), lens.K, lens.D)
    return np.asarray(pixels, dtype=float).reshape(-1, 2)
