"""The sides of each expected person in a picture of what moves: who owns which pixels, and which sides can be seen."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, Image
from visfuse_cli.vision.background import FOREGROUND

SIDEWAYS_M, UPWARDS_M = 0.3, 0.25  # how far around the expected box a person's pixels are looked for
LEAST_ROW, LEAST_COLUMN = 0.10, 0.05  # share of the width, of the height, that a side's row or column holds
BEYOND_PX = 4  # px outside of a side that tell whether something else begins there
TOUCHING = 0.35  # share of a side with something else beyond it: then it is nobody's own side
FRONT = 1.0  # lateral distance, in half widths, within which the nearer person hides the other
CAP = 3.0  # half widths beyond which a pixel is nobody's


@dataclass(frozen=True, slots=True)
class Expected:
    """People in one camera's picture, T of them: where each is expected.

    box [u0, v0, u1, v1] (T, 4) px, axis (T, 2, 2) px from foot to head, point (T, 2) px that is tracked, half_width (T,) px, depth (T,) m, scale (T,)
    px per m, reach (T,) px that each may be off, and rank (T,): a lower one owns pixels before a higher one.
    """

    box: Array
    axis: Array
    point: Array
    half_width: Array
    depth: Array
    scale: Array
    reach: Array
    rank: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.box)


@dataclass(frozen=True, slots=True)
class Sides:
    """What was seen of one person: box [u0, v0, u1, v1] (4,) px, which of its sides are its own, the share seen."""

    box: Array
    own: NDArray[np.bool_]
    share: float


def moving(labels: Image) -> Image:
    """Foreground (1) without specks of the size of coding noise."""
    mask = cv2.compare(labels, FOREGROUND, cv2.CMP_EQ)
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(cv2.min(mask, 1), np.uint8)


def sides(mask: Image, expected: Expected, who: int) -> Sides | None:
    """The sides of one of the expected people in a mask (H, W) of what moves; None where too little is seen."""
    high, wide = mask.shape
    scale, box = expected.scale[who], expected.box[who]
    around, above = SIDEWAYS_M * scale + expected.reach[who], UPWARDS_M * scale + expected.reach[who]
    left, top = max(int(box[0] - around), 0), max(int(box[1] - above), 0)
    right, bottom = min(int(box[2] + around) + 1, wide), min(int(box[3] + above) + 1, high)
    if right - left < 3 or bottom - top < 5:
        return None
    part = mask[top:bottom, left:right]
    own = part.astype(bool) & _owned(expected, who, (left, top, right, bottom))
    tall, broad = box[3] - box[1], box[2] - box[0]
    columns, rows = own.sum(axis=0), own.sum(axis=1)
    across = np.flatnonzero(columns >= max(2.0, LEAST_COLUMN * tall))
    down = np.flatnonzero(rows >= max(2.0, LEAST_ROW * broad))
    if len(across) < 2 or len(down) < 3:
        return None
    u0, u1, v0, v1 = across[0], across[-1] + 1, down[0], down[-1] + 1
    share = float(own.sum()) / max(0.55 * tall * broad, 1.0)
    found = np.array([left + u0, top + v0, left + u1, top + v1]) - 0.5  # a pixel reaches half of one to each side
    kept = ~_beyond(part, own, (u0, v0, u1, v1))
    kept &= np.array([left + u0 > 1, top + v0 > 1, left + u1 < wide - 1, top + v1 < high - 1])
    kept &= np.array([u0 > 0 or left == 0, v0 > 0 or top == 0, u1 < right - left, v1 < bottom - top])
    return Sides(found, kept, share)


def _owned(expected: Expected, who: int, window: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    """Which pixels of a window nobody else has the better claim to."""
    left, top, right, bottom = window
    u, v = np.arange(left, right), np.arange(top, bottom)
    near = _distance(expected, who, u, v)
    mine = near < CAP
    boxes = expected.box
    with np.errstate(invalid="ignore"):
        close = (boxes[:, 2] > left) & (boxes[:, 0] < right) & (boxes[:, 3] > top) & (boxes[:, 1] < bottom)
    for other in np.flatnonzero(close):
        if other == who:
            continue
        theirs = _distance(expected, int(other), u, v)
        first = expected.rank[other] < expected.rank[who]
        before = expected.rank[other] == expected.rank[who] and expected.depth[other] < expected.depth[who]
        mine &= theirs >= np.where(near < FRONT, near, CAP) if not (first or before) else theirs >= FRONT
        mine &= (near <= theirs) | (near < FRONT)
    return mine


def _distance(expected: Expected, who: int, u: NDArray[np.intp], v: NDArray[np.intp]) -> Array:
    """Distance (h, w) of pixels from a person's axis, in half widths, its ends rounded."""
    foot, head = expected.axis[who]
    along = head - foot
    length = max(float(along @ along), 1e-9)
    du, dv = u[None, :] - foot[0], v[:, None] - foot[1]
    share = np.clip((du * along[0] + dv * along[1]) / length, 0.05, 0.95)
    return np.asarray(np.hypot(du - share * along[0], dv - share * along[1]) / expected.half_width[who])


def _beyond(part: Image, own: NDArray[np.bool_], box: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    """Beyond which sides (left, top, right, bottom) of an owned box something else moves."""
    u0, v0, u1, v1 = box
    other = part.astype(bool) & ~own
    strips = (
        (own[v0:v1, u0 : u0 + BEYOND_PX], other[v0:v1, max(u0 - BEYOND_PX, 0) : u0 + BEYOND_PX], 1),
        (own[v0 : v0 + BEYOND_PX, u0:u1], other[max(v0 - BEYOND_PX, 0) : v0 + BEYOND_PX, u0:u1], 0),
        (own[v0:v1, u1 - BEYOND_PX : u1], other[v0:v1, u1 - BEYOND_PX : u1 + BEYOND_PX], 1),
        (own[v1 - BEYOND_PX : v1, u0:u1], other[v1 - BEYOND_PX : v1 + BEYOND_PX, u0:u1], 0),
    )
    touched = []
    for mine, theirs, axis in strips:
        at_side = mine.any(axis=axis)
        count = max(int(at_side.sum()), 1)
        touched.append((at_side & theirs.any(axis=axis)).sum() / count > TOUCHING)
    return np.array(touched)
