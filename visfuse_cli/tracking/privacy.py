"""Who is on the footage stays unknown: where plates and faces are, from the tracks alone and without a detector."""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Sequence

import numpy as np
from pydantic import Field

from visfuse_cli.config import Section
from visfuse_cli.records import Array, GroundCamera, Region
from visfuse_cli.tracking.output import box_corners
from visfuse_cli.vision.lens import distort_points

PLATE_HEIGHT = 0.6  # of a vehicle: plates are mounted below
ENDS = 0.25  # of a vehicle's length behind its front and before its rear that is blurred with them
HEAD, ABOVE = 0.35, 0.2  # of a person's height: how far below and above its top a head may be
BROAD = 1.6  # times as wide as the person is where the head is looked for
STRANGER = 0.2  # of its size that what moves and is no track is enlarged by, on each side
MARGIN = 0.15  # of its size in the picture that each part is enlarged by: no box is quite a vehicle


class PrivacySettings(Section):
    """What the annotated video may show."""

    blur: bool = Field(
        False, description="blur plates (lower front and rear of vehicles), heads, and whatever moves and is no track"
    )


def parts(camera: GroundCamera, pose: Array, size: Array, walks: bool, rides: bool) -> list[Array]:
    """Corners (T, 8, 2) px of the parts to blur of one track with poses (T, 3) and a size (3,) m."""
    length, width, height = size
    head = _slab(camera, pose, (BROAD * length, BROAD * width), (1 - HEAD) * height, (1 + ABOVE) * height)
    if walks:
        return [head]
    ends = []
    for side in (1, -1):
        middle = side * (1 - ENDS) * length / 2
        shifted = pose.copy()
        shifted[:, :2] += middle * np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
        ends.append(_enlarged(_slab(camera, shifted, (ENDS * length, width), 0.0, PLATE_HEIGHT * height)))
    return [*ends, head] if rides else ends


def _slab(camera: GroundCamera, pose: Array, base: tuple[float, float], low: float, high: float) -> Array:
    """Corners (T, 8, 2) px of a block over a base (length, width) m between two heights m."""
    ends = [box_corners(camera, pose, np.tile([*base, level], (len(pose), 1)))[:, 4:] for level in (low, high)]
    return np.concatenate(ends, axis=1)


def _enlarged(corners: Array) -> Array:
    middle = corners.mean(axis=1, keepdims=True)
    return np.asarray(middle + (1 + 2 * MARGIN) * (corners - middle))


class Strangers:
    """Where something moved that is no track, frame by frame: it may have a face or a plate all the same."""

    def __init__(self, camera: GroundCamera) -> None:
        self._lens = camera.ground.lens
        self._frames, self._boxes = array("q"), array("f")

    def add(self, frame: int, regions: Sequence[Region]) -> None:
        """Remember a frame's regions."""
        for region in regions:
            hull = region.hull if self._lens is None else distort_points(region.hull, self._lens)
            self._frames.append(frame)
            self._boxes.extend([*hull.min(axis=0), *hull.max(axis=0)])

    def outlines(self, frame: int) -> list[Array]:
        """Upright boxes (4, 2) px around what was there in a frame."""
        first, last = bisect_left(self._frames, frame), bisect_right(self._frames, frame)
        ends = np.array(self._boxes[4 * first : 4 * last], dtype=float).reshape(-1, 2, 2)
        spare = STRANGER * (ends[:, 1] - ends[:, 0])
        boxes = np.concatenate([ends[:, 0] - spare, ends[:, 1] + spare], axis=1)
        return [box[[[0, 1], [2, 1], [2, 3], [0, 3]]] for box in boxes]
