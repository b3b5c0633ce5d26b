"""A roughly picked point moved onto the corner or the edge that was meant."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Image
from visfuse_cli.vision.line_tracing import snap

QUALITY = 0.15  # of the strongest corner nearby
SETTLED = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 0.005)
WINDOW = 3  # px either side of a corner that tell where it is


def snap_point(image: Image, point: Array, radius_px: float) -> Array | None:
    """The corner (2,) px within `radius_px` of a picked point (2,), to a fraction of a pixel; None where there is none.

    Of several the one wins that is strong for its distance.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    reach = int(np.ceil(radius_px)) + 2 * WINDOW
    left, top = np.maximum(np.round(point).astype(int) - reach, 0)
    patch = np.ascontiguousarray(grey[top : top + 2 * reach + 1, left : left + 2 * reach + 1])
    if min(patch.shape) < 4 * WINDOW or np.ptp(patch) < 8:
        return None
    strength = cv2.cornerMinEigenVal(cv2.GaussianBlur(patch, (0, 0), 0.8), 3)
    corners = cv2.goodFeaturesToTrack(patch, 30, QUALITY, 3)
    if corners is None:
        return None
    found = cv2.cornerSubPix(patch, corners.copy(), (WINDOW, WINDOW), (-1, -1), SETTLED).reshape(-1, 2)
    rough = corners.reshape(-1, 2)
    found = np.where(np.linalg.norm(found - rough, axis=1, keepdims=True) < WINDOW, found, rough)
    apart = np.linalg.norm(found + [left, top] - point, axis=1)
    column, row = np.round(rough).astype(int).T
    worth = np.where(apart <= radius_px, strength[row, column] * np.exp(-((apart / radius_px) ** 2)), 0.0)
    best = int(np.argmax(worth))
    return np.asarray(found[best] + [left, top], dtype=float) if worth[best] > 0 else None


def snap_line(image: Image, line: Array, radius_px: float) -> Array | None:
    """A drawn line (4,) px moved onto the edge under it; None where there is none."""
    moved, found = snap(image, line[None], radius_px)
    return moved[0] if found[0] else None
