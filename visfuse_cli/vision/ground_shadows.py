"""A shadow lies on the ground, a person stands on it: what is dark in one picture is told apart by the others."""

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
BLOCK = 4  # px: what is dark is looked at in blocks of this side
HEIGHTS = np.linspace(0.15, 1.95, 25)  # m above the ground at which a line of sight may meet somebody


class GroundShadows:
    """The ground z = 0 about `places` (n, 2) m where people can be, as cameras P (C, 3, 4), sizes (C, 2) px, see it."""

    def __init__(self, P: Array, sizes: Array, places: Array) -> None:
        low, high = places.min(axis=0) - AROUND_M, places.max(axis=0) + AROUND_M
        middle, step = (low + high) / 2, max(FINEST_M, float((high - low).max()) / CELLS)
        line = (np.arange(CELLS) - CELLS / 2 + 0.5) * step
        x, y = np.meshgrid(middle[0] + line, middle[1] + line)
        ground = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
        self._P, self._sizes = P, sizes.astype(int)
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
        """Labels (H, W) by camera with what is no shadow made foreground.

        It is none where most cameras see that ground unchanged, and most see something on the line of sight above it.
        """
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
            raised = dark[camera][(where < 0) | ~shadow[where]]
            upright = raised[self._met(camera, raised, labels)]
            settled[camera] = picture.copy()
            settled[camera].ravel()[upright] = FOREGROUND
        return settled

    def _met(self, camera: int, pixels: NDArray[np.intp], labels: dict[int, Image]) -> NDArray[np.bool_]:
        """Whether the lines of sight of pixels (n,), in blocks, meet what most other cameras see changed."""
        wide = int(self._sizes[camera, 0])
        v, u = np.divmod(pixels, wide)
        block, of = np.unique(v // BLOCK * wide + u // BLOCK, return_inverse=True)
        middle = np.column_stack([block % wide, block // wide]) * BLOCK + (BLOCK - 1) / 2
        M, p = self._P[camera, :, :3], self._P[camera, :, 3]
        centre = -np.linalg.solve(M, p)
        way = np.linalg.solve(M, np.column_stack([middle, np.ones(len(middle))]).T).T
        with np.errstate(divide="ignore", invalid="ignore"):
            far = (HEIGHTS - centre[2]) / way[:, 2:]
        points = centre + np.where(far > 0, far, np.nan)[..., None] * way[:, None]
        votes, holders = np.zeros(far.shape, int), np.zeros(far.shape, int)
        for other in (c for c in labels if c != camera):
            inside, columns, rows = self._pixels(other, points)
            holders += inside
            votes += inside & (labels[other][rows, columns] > 0)
        met: NDArray[np.bool_] = np.any(2 * votes > holders, axis=1)
        return met[of]

    def _pixels(self, camera: int, points: Array) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
        """Which points (..., 3) a picture holds, and their columns and rows in it, 0 for the others."""
        seen = points @ self._P[camera, :, :3].T + self._P[camera, :, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = np.rint(seen[..., :2] / seen[..., 2:])
            inside = (seen[..., 2] > 0) & np.all((pixels >= 0) & (pixels < self._sizes[camera]), axis=-1)
        u, v = np.moveaxis(np.where(inside[..., None], pixels, 0).astype(np.intp), -1, 0)
        return inside, u, v


def _cells(camera: Array, size: NDArray[np.intp], middle: Array, step: float) -> NDArray[np.int32]:
    """The cell of the ground that each pixel (H * W,) of a picture shows; -1 above the horizon and out of the area."""
    u, v = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    places, _ = multiview.on_plane(camera, np.column_stack([u.ravel(), v.ravel()]))
    level: NDArray[np.bool_] = np.asarray(np.isfinite(places).all(axis=1), dtype=bool)
    index = np.floor((np.where(level[:, None], places, 0) - middle) / step + CELLS / 2)
    inside = level & np.all((index >= 0) & (index < CELLS), axis=1)
    return np.where(inside, index[:, 1] * CELLS + index[:, 0], -1).astype(np.int32)
