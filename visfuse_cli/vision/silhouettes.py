"""The sides of each expected person in a picture of what moves: who owns which pixels, and which sides can be seen."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, Image
from visfuse_cli.vision.background import FOREGROUND
from visfuse_cli.vision.backing import covered

SIDEWAYS_M, UPWARDS_M = 0.3, 0.25  # how far around the expected box a person's pixels are looked for
LEAST_ROW, LEAST_COLUMN = 0.10, 0.05  # share of the width, of the height, that a side's row or column holds
BEYOND_PX = 4  # px outside of a side that tell whether something else begins there
PARTLY_PX = 0.4  # px that a silhouette reaches too far: pixels that are covered in part count as a whole
LEAST_ROWS = 0.25  # share of a person's rows that must tell where its side is
TOUCHING = 0.35  # share of a side with something else beyond it: then it is nobody's own side
FRONT = 1.0  # lateral distance, in half widths, within which the nearer person hides the other
CAP = 3.0  # half widths beyond which a pixel is nobody's


@dataclass(frozen=True, slots=True)
class Expected:
    """People in one camera's picture, T of them: where each is expected.

    box [u0, v0, u1, v1] (T, 4) px, axis (T, 2, 2) px from foot to head, point (T, 2) px that is tracked,
    half_width (T,) px, depth (T,) m, scale (T,) px per m upwards, slope (T,) m upwards that look like one towards the
    camera, level (T,) m of the feet above the ground, reach (T,) px that each may be off, and rank (T,): a lower one
    owns pixels before a higher one.
    """

    box: Array
    axis: Array
    point: Array
    half_width: Array
    depth: Array
    scale: Array
    slope: Array
    level: Array
    reach: Array
    rank: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.box)


@dataclass(frozen=True, slots=True)
class Sides:
    """What was seen of one person: box [u0, v0, u1, v1] (4,) px, points (n, 2) px of its rim, and the share seen.

    `top` and `bottom` say whether these ends of the box are its own.

    Across, row by row from the expected axis, the median over rows of which a side is the person's own: `middle` px by
    which it is off, `left` and `right` px that it reaches; NaN where too few rows tell.
    """

    box: Array
    rim: Array
    top: bool
    bottom: bool
    share: float
    middle: float
    left: float
    right: float


def moving(labels: Image) -> Image:
    """Foreground (1) without specks of the size of coding noise."""
    mask = cv2.compare(labels, FOREGROUND, cv2.CMP_EQ)
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return np.asarray(cv2.min(mask, 1), np.uint8)


def sides(mask: Image, outside: Image, expected: Expected, who: int, backed: Array | None) -> Sides | None:
    """The sides of one of the expected people in a mask (H, W) of what moves; None where too little is seen.

    `outside` (H, W) is where the picture does not reach. What lies in none of the boxes `backed` (n, 4) px, if there
    are any, is not the person's.
    """
    high, wide = mask.shape
    scale, box = expected.scale[who], expected.box[who]
    around, above = SIDEWAYS_M * scale + expected.reach[who], UPWARDS_M * scale + expected.reach[who]
    left, top = max(int(box[0] - around), 0), max(int(box[1] - above), 0)
    right, bottom = min(int(box[2] + around) + 1, wide), min(int(box[3] + above) + 1, high)
    if right - left < 3 or bottom - top < 5:
        return None
    part, window = mask[top:bottom, left:right], (left, top, right, bottom)
    own = part.astype(bool) & _owned(expected, who, window)
    if backed is not None:
        own &= covered(backed, window)
    tall, broad = box[3] - box[1], box[2] - box[0]
    columns, rows = own.sum(axis=0), own.sum(axis=1)
    across = np.flatnonzero(columns >= max(2.0, LEAST_COLUMN * tall))
    down = np.flatnonzero(rows >= max(2.0, LEAST_ROW * broad))
    if len(across) < 2 or len(down) < 3:
        return None
    u0, u1, v0, v1 = int(across[0]), int(across[-1]) + 1, int(down[0]), int(down[-1]) + 1
    # A pixel reaches half of one to each side, and at a border it is new as soon as a part of it is.
    found = np.array([left + u0, top + v0, left + u1, top + v1]) - 0.5 + PARTLY_PX * np.array([1, 1, -1, -1])
    other = (part.astype(bool) & ~own) | outside[top:bottom, left:right].astype(bool)
    return Sides(
        found,
        _rim(own[down][:, u0:u1], down) + [left + u0, top],
        bool(top + v0 > 1 and (v0 > 0 or top == 0) and not _touched(own, other, v0, -1)),
        bool(top + v1 < high - 1 and v1 < bottom - top and not _touched(own, other, v1, 1)),
        float(own.sum()) / max(0.55 * tall * broad, 1.0),
        *_across(own, other, down, expected.axis[who] - [left, top], left == 0),
    )


def _rim(own: NDArray[np.bool_], rows: NDArray[np.intp]) -> Array:
    """The first and the last pixel, and a half, of each of the rows (n,) in which somebody is, own (n, w)."""
    there = own.any(axis=1)
    first, last = own.argmax(axis=1)[there] - 0.5, own.shape[1] - 0.5 - own[:, ::-1].argmax(axis=1)[there]
    ends = [np.column_stack([u, rows[there] + half]) for u in (first, last) for half in (-0.5, 0.5)]
    return np.concatenate(ends)


def _across(
    own: NDArray[np.bool_],
    other: NDArray[np.bool_],
    rows: NDArray[np.intp],
    axis: Array,
    at_border: bool,
) -> tuple[float, float, float]:
    """Offset of the middle, and reach to the left and to the right, from the axis (2, 2) px over `rows` of a window."""
    foot, head = axis
    own, other = own[rows], other[rows]
    wide = own.shape[1]
    first, last = own.argmax(axis=1), wide - 1 - own[:, ::-1].argmax(axis=1)
    u = foot[0] + (rows - foot[1]) * (head[0] - foot[0]) / min(head[1] - foot[1], -1e-6)
    near = np.arange(wide)[None]
    free = (
        ~np.any(other & (near < first[:, None]) & (near >= first[:, None] - BEYOND_PX), axis=1),
        ~np.any(other & (near > last[:, None]) & (near <= last[:, None] + BEYOND_PX), axis=1),
    )
    free = (free[0] & (first > (1 if at_border else 0)), free[1] & (last < wide - 1))
    reach_left, reach_right = u - first + 0.5, last - u + 0.5
    least = max(3, LEAST_ROWS * len(rows))

    def middle_of(values: Array, told: NDArray[np.bool_]) -> float:
        return float(np.median(values[told])) if np.count_nonzero(told) >= least else np.nan

    return (
        middle_of((reach_right - reach_left) / 2, free[0] & free[1]),
        middle_of(reach_left, free[0]),
        middle_of(reach_right, free[1]),
    )


def _touched(own: NDArray[np.bool_], other: NDArray[np.bool_], row: int, way: int) -> bool:
    """Whether something else moves beyond (`way` -1: above, 1: below) an owned box that ends at a row."""
    inner = slice(row, row + BEYOND_PX) if way < 0 else slice(max(row - BEYOND_PX, 0), row)
    outer = slice(max(row - BEYOND_PX, 0), row + BEYOND_PX)
    at_side = own[inner].any(axis=0)
    return bool((at_side & other[outer].any(axis=0)).sum() > TOUCHING * max(int(at_side.sum()), 1))


def _owned(expected: Expected, who: int, window: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    """Which pixels of a window nobody else has the better claim to."""
    left, top, right, bottom = window
    u, v = np.arange(left, right), np.arange(top, bottom)
    near = _distance(expected, who, u, v)
    mine = near < CAP**2
    boxes = expected.box
    with np.errstate(invalid="ignore"):
        close = (boxes[:, 2] > left) & (boxes[:, 0] < right) & (boxes[:, 3] > top) & (boxes[:, 1] < bottom)
    for other in np.flatnonzero(close):
        if other == who:
            continue
        theirs = _distance(expected, int(other), u, v)
        first = expected.rank[other] < expected.rank[who]
        before = expected.rank[other] == expected.rank[who] and expected.depth[other] < expected.depth[who]
        mine &= theirs >= np.where(near < FRONT**2, near, CAP**2) if not (first or before) else theirs >= FRONT**2
        mine &= (near <= theirs) | (near < FRONT**2)
    return mine


def _distance(expected: Expected, who: int, u: NDArray[np.intp], v: NDArray[np.intp]) -> NDArray[np.float32]:
    """Squared distance (h, w) of pixels from a person's axis, in half widths, its ends rounded."""
    foot, head = expected.axis[who]
    along = head - foot
    length = max(float(along @ along), 1e-9)
    du, dv = (u - foot[0]).astype(np.float32)[None], (v - foot[1]).astype(np.float32)[:, None]
    share = np.clip(du * np.float32(along[0] / length) + dv * np.float32(along[1] / length), 0.05, 0.95)
    du = du - share * np.float32(along[0])
    dv = dv - share * np.float32(along[1])
    return np.asarray((du * du + dv * dv) * np.float32(expected.half_width[who] ** -2), np.float32)
