"""A shadow lies on the ground: what is dark in one picture is none where others see the ground under it unchanged."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import multiview
from visfuse_cli.records import Array, Image
from visfuse_cli.vision.background import FOREGROUND, SHADOW

CELLS = 512  # along a side of the ground
FINEST_M = 0.03
AROUND_M = 2.0  # how far from people their shadows are of interest


class GroundShadows:
    """The ground z = 0 about `places` (n, 2) m where people can be, as cameras P (C, 3, 4), sizes (C, 2) px, see it."""

    def __init__(self, P: Array, sizes: Array, places: Array) -> None:
        low, high = places.min(axis=0) - AROUND_M, places.max(axis=0) + AROUND_M
        middle, step = (low + high) / 2, max(FINEST_M, float((high - low).max()) / CELLS)
        line = (np.arange(CELLS) - CELLS / 2 + 0.5) * step
        x, y = np.meshgrid(middle[0] + line, middle[1] + line)
        ground = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
        self._from_picture, self._cell = [], []
        self._holders = np.zeros((CELLS, CELLS), np.uint8)
        for camera, size in zip(P, sizes.astype(int), strict=True):
            pixels, _ = multiview.project(camera, ground)
            pixels = np.where(np.isfinite(pixels) & (np.abs(pixels) < 1e4), pixels, -9)
            self._holders += np.all((pixels > -0.5) & (pixels < size - 0.5), axis=1).reshape(CELLS, CELLS)
            maps = pixels.astype(np.float32).reshape(CELLS, CELLS, 2)
            self._from_picture.append(cv2.convertMaps(maps, None, cv2.CV_16SC2, nninterpolation=True)[0])
            self._cell.append(_cells(camera, size, middle, step))

    def settle(self, labels: dict[int, Image]) -> dict[int, Image]:
        """Labels (H, W) by camera with what is no shadow made foreground; what one camera alone sees is left."""
        dark = {camera: np.flatnonzero(picture == SHADOW) for camera, picture in labels.items()}
        if not any(len(each) for each in dark.values()):
            return labels
        votes = np.zeros((CELLS, CELLS), np.uint8)
        for camera, picture in labels.items():
            changed = cv2.dilate(cv2.min(picture, 1), np.ones((3, 3), np.uint8))
            votes += cv2.remap(changed, self._from_picture[camera], None, cv2.INTER_NEAREST)
        shadow: NDArray[np.bool_] = np.logical_or(2 * votes > self._holders, self._holders < 2).ravel()
        settled = {}
        for camera, picture in labels.items():
            where = self._cell[camera].take(dark[camera])
            upright = dark[camera][(where < 0) | ~shadow[where]]
            settled[camera] = picture.copy()
            settled[camera].ravel()[upright] = FOREGROUND
        return settled


def _cells(camera: Array, size: NDArray[np.intp], middle: Array, step: float) -> NDArray[np.int32]:
    """The cell of the ground that each pixel (H * W,) of a picture shows; -1 above the horizon and out of the area."""
    u, v = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    places, _ = multiview.on_plane(camera, np.column_stack([u.ravel(), v.ravel()]))
    level: NDArray[np.bool_] = np.asarray(np.isfinite(places).all(axis=1), dtype=bool)
    index = np.floor((np.where(level[:, None], places, 0) - middle) / step + CELLS / 2)
    inside = level & np.all((index >= 0) & (index < CELLS), axis=1)
    return np.where(inside, index[:, 1] * CELLS + index[:, 0], -1).astype(np.int32)
