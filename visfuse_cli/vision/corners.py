"""A roughly picked point moved onto the corner that was meant, or the middle of a short edge, as of a dash's end."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Image
from visfuse_cli.vision.line_tracing import snap

QUALITY = 0.1  # of the strongest corner nearby
SETTLED = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 0.005)
WINDOW = 3  # px either side of a corner that tell where it is
SHORTEST = 3.0  # px between two corners of an edge
ACROSS = 2.0  # px either side of an edge, where its contrast is measured
CONTRAST = 0.3  # of all the contrast nearby: what an edge has at least across its middle


def snap_point(image: Image, point: Array, radius_px: float) -> Array | None:
    """The corner, or middle of an edge between two corners, (2,) px within `radius_px` of a picked point (2,).

    To a fraction of a pixel; of several the one wins that is strong for its distance; None where there is none.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    reach = int(np.ceil(2 * radius_px)) + 2 * WINDOW
    left, top = np.maximum(np.round(point).astype(int) - reach, 0)
    patch = np.ascontiguousarray(grey[top : top + 2 * reach + 1, left : left + 2 * reach + 1])
    if min(patch.shape) < 4 * WINDOW or np.ptp(patch) < 8:
        return None
    places, strengths = _corners(patch)
    middles, edge_strengths = _middles(patch, places, strengths, 2 * radius_px)
    places, strengths = np.concatenate([places, middles]), np.concatenate([strengths, edge_strengths])
    apart = np.linalg.norm(places + [left, top] - point, axis=1)
    worth = np.where(apart <= radius_px, strengths * np.exp(-((2 * apart / radius_px) ** 2)), 0.0)
    if not np.any(worth > 0):
        return None
    return np.asarray(places[int(np.argmax(worth))] + [left, top], dtype=float)


def _corners(patch: Image) -> tuple[Array, Array]:
    """Corners (n, 2) px of a grey patch, and how strong (n,) each is."""
    strength = cv2.cornerMinEigenVal(cv2.GaussianBlur(patch, (0, 0), 0.8), 3)
    rough = cv2.goodFeaturesToTrack(patch, 30, QUALITY, 3)
    if rough is None:
        return np.zeros((0, 2)), np.zeros(0)
    fine = cv2.cornerSubPix(patch, rough.copy(), (WINDOW, WINDOW), (-1, -1), SETTLED).reshape(-1, 2)
    rough = rough.reshape(-1, 2)
    settled = np.linalg.norm(fine - rough, axis=1, keepdims=True) < WINDOW
    column, row = np.round(rough).astype(int).T
    return np.where(settled, fine, rough).astype(float), strength[row, column].astype(float)


def _middles(patch: Image, corners: Array, strengths: Array, longest: float) -> tuple[Array, Array]:
    """Middles (m, 2) px of edges up to `longest` px between two corners, each as strong (m,) as its weaker corner."""
    a, b = np.triu_indices(len(corners), 1)
    along = corners[b] - corners[a]
    length = np.linalg.norm(along, axis=1)
    near = (length >= SHORTEST) & (length <= longest)
    a, b, along, length = a[near], b[near], along[near], length[near]
    if not len(a):
        return np.zeros((0, 2)), np.zeros(0)
    middle = (corners[a] + corners[b]) / 2
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / length[:, None] * ACROSS
    sides = [cv2.remap(patch, (middle + s * normal).astype(np.float32)[None], None, cv2.INTER_LINEAR) for s in (-1, 1)]
    step = np.abs(sides[0].astype(float) - sides[1]).reshape(-1)
    edge = step > CONTRAST * float(np.ptp(patch))
    return middle[edge], np.minimum(strengths[a], strengths[b])[edge]


def snap_line(image: Image, line: Array, radius_px: float) -> Array | None:
    """A drawn line (4,) px moved onto the edge under it; None where there is none."""
    moved, found = snap(image, line[None], radius_px)
    return moved[0] if found[0] else None
