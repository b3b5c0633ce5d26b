"""Where on the ground somebody may stand: places whose upright box moves in several pictures at once."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import people
from visfuse_cli.records import Array, Image

STEP_M = 0.15
FARTHEST_M = 18.0  # m from the cameras' middle
SMALLEST_PX = 24  # of a person's height, to be found
LEAST_PX = 50  # pixels that the trunk of the smallest fills
TRUNK_M = 0.36  # width of the box that a person should fill
FILLED, EXPECTED = 0.42, 0.35  # share of that box that moves where somebody stands, and what speaks for nobody
MOST = 60_000  # places; a larger area is searched in larger steps
AT_ONCE = 4096  # places whose boxes are computed at once: memory that is free again before anything is followed


class Occupancy:
    """The places that two cameras or more hold in their pictures, P (C, 3, 4) and sizes (C, 2) px."""

    def __init__(self, P: Array, sizes: Array, height: float) -> None:
        centres = -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[..., 0]
        middle = centres[:, :2].mean(axis=0)
        reach = min(FARTHEST_M, float(np.linalg.norm(centres[:, :2] - middle, axis=1).max()) + FARTHEST_M / 2)
        step = max(STEP_M, float(np.sqrt((2 * reach) ** 2 / MOST)))
        line = np.arange(-reach, reach, step)
        x, y = np.meshgrid(middle[0] + line, middle[1] + line)
        places = np.column_stack([x.ravel(), y.ravel()])
        boxes = _trunks(P, places, height)
        size = np.concatenate([[[0, 0]] * len(P), sizes], axis=1)[None]
        with np.errstate(invalid="ignore"):
            low, high = np.maximum(boxes[..., :2], size[..., :2]), np.minimum(boxes[..., 2:], size[..., 2:])
            area = np.prod(np.maximum(boxes[..., 2:] - boxes[..., :2], 1e-6), axis=-1)
            inside = np.prod(np.clip(high - low, 0, None), axis=-1) / area
            seen = (inside > 0.7) & (boxes[..., 3] - boxes[..., 1] > SMALLEST_PX)
        held = np.count_nonzero(seen, axis=1) >= 2
        self.places, self._seen = places[held], seen[held]
        corner = np.where(seen[held][..., None], np.concatenate([low, high], axis=-1)[held], 0)
        self._corner = np.rint(corner).astype(np.intp)

    def likeliest(self, masks: dict[int, Image], tried: list[Array], apart: float) -> Array | None:
        """The place (2,) m that most speaks for, of cameras with masks (H, W), not near what was `tried`; or None."""
        enough = [mask for mask in masks.values() if cv2.countNonZero(mask) > LEAST_PX]
        if not len(self.places) or len(enough) < 2:
            return None
        total, filled = np.zeros(len(self.places)), np.zeros(len(self.places), dtype=int)
        for camera, mask in masks.items():
            share = self._filled(cv2.integral(mask), camera)
            seen = self._seen[:, camera]
            total += np.where(seen, share - EXPECTED, 0.0)
            filled += seen & (share > FILLED)
        total[filled < 2] = -np.inf
        for place in tried:
            total[np.linalg.norm(self.places - place, axis=1) < apart] = -np.inf
        best = int(np.argmax(total))
        return self.places[best] if total[best] > 0 else None

    def _filled(self, summed: NDArray[np.int32], camera: int) -> Array:
        """How much of each place's box moves, from the mask's summed areas."""
        u0, v0, u1, v1 = self._corner[:, camera].T
        area = np.maximum((u1 - u0) * (v1 - v0), 1)
        return np.asarray((summed[v1, u1] - summed[v0, u1] - summed[v1, u0] + summed[v0, u0]) / area)


def _trunks(P: Array, places: Array, height: float) -> Array:
    """Boxes (n, C, 4) px of narrow upright people at places (n, 2) m."""
    foot = np.column_stack([places, np.zeros(len(places))])
    found = np.empty((len(places), len(P), 4))
    for begin in range(0, len(places), AT_ONCE):
        part = slice(begin, begin + AT_ONCE)
        each = np.full(len(foot[part]), height)
        outline = people.outline(foot[part], each, np.full(len(each), TRUNK_M))
        for camera, projection in enumerate(P):
            found[part, camera] = people.boxes(projection, outline)
    return found
