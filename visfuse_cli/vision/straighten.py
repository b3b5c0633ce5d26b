"""Pictures as a camera without distortion would take them, at a size that is quick to look at."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Image, View
from visfuse_cli.vision.lens import distort_points, undistort_points

WIDEST = 2.0  # times its own size that a picture may grow as its distortion is taken out


class Straight:
    """One camera's pictures straightened and, beyond `pixels`, made smaller; K (3, 3) and size (w, h) px of the result.

    Pixels of the result and undistorted pixels at full size, on the calibration's K, are led into each other.
    """

    def __init__(self, view: View, pixels: int) -> None:
        self._lens = view.lens
        wide, high = view.size
        self._shrink = max(1.0, float(np.sqrt(wide * high / pixels)))
        self._small = (max(1, round(wide / self._shrink)), max(1, round(high / self._shrink)))
        self._distorted = bool(np.any(view.lens.D))
        low, self.size = np.zeros(2), self._small
        self._scale = np.array(self._small) / np.array(view.size)
        if self._distorted:
            low, self.size = self._frame(view)
        self._low = low
        shift = np.array([self._scale[0] / 2 - 0.5, self._scale[1] / 2 - 0.5]) - low
        self.K = np.array([[self._scale[0], 0, shift[0]], [0, self._scale[1], shift[1]], [0, 0, 1.0]]) @ view.lens.K
        self._maps = self._remap() if self._distorted else None

    def picture(self, image: Image) -> Image:
        """The picture (h, w, 3) of a frame (H, W, 3); black where the frame does not reach."""
        if self._small != (image.shape[1], image.shape[0]):
            image = np.asarray(cv2.resize(image, self._small, interpolation=cv2.INTER_AREA), np.uint8)
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), np.uint8)

    def shown(self, boxes: Array) -> Array:
        """Boxes [x, y, w, h] (n, 4) px of the footage around boxes [u0, v0, u1, v1] (n, 4) of the result."""
        u0, v0, u1, v1 = boxes.T
        across, down = (u0 + u1) / 2, (v0 + v1) / 2
        sides = np.stack([np.column_stack(p) for p in ((u0, down), (across, v0), (u1, down), (across, v1))], axis=1)
        points = self._full(sides.reshape(-1, 2))
        if self._distorted:
            points = distort_points(points, self._lens)
        low, high = (edge(points.reshape(-1, 4, 2), axis=1) for edge in (np.min, np.max))
        return np.concatenate([low, high - low], axis=1)

    def _full(self, points: Array) -> Array:
        """Undistorted pixels at full size (n, 2) of pixels of the result (n, 2)."""
        return np.asarray((points + self._low + 0.5) / self._scale - 0.5)

    def _frame(self, view: View) -> tuple[Array, tuple[int, int]]:
        """Upper left corner (2,) px and size of the result that holds the whole frame, if that is not too large."""
        wide, high = view.size
        along = np.linspace(0, 1, 25)
        nil = np.zeros_like(along)
        border = np.concatenate(
            [np.column_stack(side) for side in ((along, nil), (along, nil + 1), (nil, along), (nil + 1, along))]
        )
        seen = undistort_points(border * [wide - 1, high - 1], view.lens)
        size = np.array(view.size, dtype=float)
        middle, reach = (size - 1) / 2, WIDEST * size / 2
        low = np.clip(np.floor(seen.min(axis=0)), middle - reach, 0) * self._scale
        top = np.clip(np.ceil(seen.max(axis=0)) + 1, size, middle + reach) * self._scale
        low, top = np.floor(low), np.ceil(top)
        return low, (int(top[0] - low[0]), int(top[1] - low[1]))

    def _remap(self) -> tuple[np.ndarray, np.ndarray]:
        wide, high = self.size
        u, v = np.meshgrid(np.arange(wide, dtype=float), np.arange(high, dtype=float))
        full = self._full(np.column_stack([u.ravel(), v.ravel()]))
        frame = (distort_points(full, self._lens) + 0.5) * self._scale - 0.5
        maps = frame.reshape(high, wide, 2).astype(np.float32)
        exact: tuple[np.ndarray, np.ndarray] = cv2.convertMaps(maps, None, cv2.CV_16SC2)
        return exact
