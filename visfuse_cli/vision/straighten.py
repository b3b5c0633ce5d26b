"""Pictures as an upright camera without distortion would take them, at a size that is quick to look at."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Image, View
from visfuse_cli.vision.lens import distort_points, undistort_points

WIDEST = 2.0  # times its own size that a picture may grow as it is straightened
ROLLED = np.radians(8.0)  # from which on a camera's roll is taken out: people then stand along columns
LEVEL = 0.2  # sine of the axis off the vertical below which a camera looks straight down and nothing is up


class Straight:
    """One camera's pictures straightened, upright and, beyond `pixels`, made smaller.

    K (3, 3) leads from the calibration's camera frame to pixels of the result, of size (w, h) px; `small` is the size
    of the footage once it is made smaller, and `outside` (h, w) is 1 where the result shows none of it.
    """

    def __init__(self, view: View, pixels: int) -> None:
        self._lens = view.lens
        wide, high = view.size
        shrink = max(1.0, float(np.sqrt(wide * high / pixels)))
        self.small = (max(1, round(wide / shrink)), max(1, round(high / shrink)))
        self._scale = np.array(self.small) / np.array(view.size)
        angle = roll(view)
        self._moved = bool(np.any(view.lens.D)) or angle != 0
        # From undistorted pixels at full size: turned about the axis of sight, shrunk, shifted.
        c, s = np.cos(angle), np.sin(angle)
        upright = view.lens.K @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) @ np.linalg.inv(view.lens.K)
        a, b = self._scale
        self._from_full = np.array([[a, 0, a / 2 - 0.5], [0, b, b / 2 - 0.5], [0, 0, 1.0]]) @ upright
        self.size = self.small
        if self._moved:
            low, self.size = self._frame(view)
            self._from_full[:2] -= low[:, None] * self._from_full[2]
        self.K = self._from_full @ view.lens.K
        self._maps = self._remap() if self._moved else None
        self.outside: Image = np.zeros(self.size[::-1], np.uint8)
        if self._maps is not None:
            inside = cv2.remap(np.ones(self.small[::-1], np.uint8), *self._maps, cv2.INTER_LINEAR)
            self.outside = np.asarray(inside == 0, np.uint8)

    def picture(self, image: Image) -> Image:
        """The picture (h, w, 3) of a frame (H, W, 3); black where the frame does not reach."""
        if self.small != (image.shape[1], image.shape[0]):
            image = np.asarray(cv2.resize(image, self.small, interpolation=cv2.INTER_AREA), np.uint8)
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), np.uint8)

    def shown(self, points: Array) -> Array:
        """The box [x, y, w, h] px of the footage around points (n, 2) px of the result."""
        points = self._full(points)
        if np.any(self._lens.D):
            points = distort_points(points, self._lens)
        low, high = points.min(axis=0), points.max(axis=0)
        return np.concatenate([low, high - low])

    def _full(self, points: Array) -> Array:
        """Undistorted pixels at full size (n, 2) of pixels of the result (n, 2)."""
        back = np.linalg.inv(self._from_full)
        return np.asarray(points @ back[:2, :2].T + back[:2, 2])

    def _frame(self, view: View) -> tuple[Array, tuple[int, int]]:
        """Upper left corner (2,) px and size of the result that holds the whole frame, if that is not too large."""
        wide, high = view.size
        along = np.linspace(0, 1, 25)
        nil = np.zeros_like(along)
        border = np.concatenate(
            [np.column_stack(side) for side in ((along, nil), (along, nil + 1), (nil, along), (nil + 1, along))]
        )
        seen = undistort_points(border * [wide - 1, high - 1], view.lens)
        seen = seen @ self._from_full[:2, :2].T + self._from_full[:2, 2]
        middle = self._from_full[:2, :2] @ ((np.array(view.size) - 1) / 2) + self._from_full[:2, 2]
        reach = WIDEST * max(self.small) / 2
        low = np.floor(np.maximum(seen.min(axis=0), middle - reach))
        top = np.ceil(np.minimum(seen.max(axis=0), middle + reach)) + 1
        return low, (int(top[0] - low[0]), int(top[1] - low[1]))

    def _remap(self) -> tuple[np.ndarray, np.ndarray]:
        wide, high = self.size
        u, v = np.meshgrid(np.arange(wide, dtype=float), np.arange(high, dtype=float))
        full = self._full(np.column_stack([u.ravel(), v.ravel()]))
        frame = distort_points(full, self._lens) if np.any(self._lens.D) else full
        maps = ((frame + 0.5) * self._scale - 0.5).reshape(high, wide, 2).astype(np.float32)
        exact: tuple[np.ndarray, np.ndarray] = cv2.convertMaps(maps, None, cv2.CV_16SC2)
        return exact


def roll(view: View) -> float:
    """The angle (rad) by which the vertical, z in the world, leans to the right in the middle of a camera's picture.

    0 where it is below ROLLED, or where the camera looks straight down or up.
    """
    right, down = view.R[0, 2], view.R[1, 2]
    angle = float(np.arctan2(right, -down))
    return angle if np.hypot(right, down) > LEVEL and abs(angle) > ROLLED else 0.0
