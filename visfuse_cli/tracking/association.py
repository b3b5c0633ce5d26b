"""Which region belongs to which followed thing, decided by the outlines predicted for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.assignment import assign
from visfuse_cli.records import Array, Region
from visfuse_cli.vision import regions as region_tools
from visfuse_cli.vision.wireframe import DIRECTIONS, FAN

INSIDE = 0.6  # share of a region inside a predicted box that makes it a part of that thing
COVERED = 0.5  # share of a predicted box under one region that makes the thing a part of that region
OWN_PX = 2.0  # lead that makes a tangent of a shared region one thing's own


@dataclass(frozen=True, slots=True)
class Claim:
    """The region a thing is seen as, and which of its tangents (K,) are the thing's own."""

    region: Region
    own: np.ndarray


def boxes_of(reach: Array) -> Array:
    """Upright boxes [x0, y0, x1, y1] (N, 4) of tangents (N, K)."""
    quarter = DIRECTIONS // 4
    return np.stack([-reach[:, 2 * quarter], -reach[:, 3 * quarter], reach[:, 0], reach[:, quarter]], axis=1)


def reach_of(boxes: Array) -> Array:
    """Tangents (N, K) of upright boxes [x0, y0, x1, y1] (N, 4)."""
    corners = boxes[:, [[0, 1], [2, 1], [0, 3], [2, 3]]]
    return np.asarray(np.max(corners @ FAN.T, axis=1))


def overlap(first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Intersection over union, over the first's and over the second's area, of boxes (n, 4) and (m, 4): each (n, m)."""
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=2)
    area_first = np.prod(np.clip(first[:, 2:] - first[:, :2], 1e-9, None), axis=1)[:, None]
    area_second = np.prod(np.clip(second[:, 2:] - second[:, :2], 1e-9, None), axis=1)[None]
    return shared / (area_first + area_second - shared), shared / area_first, shared / area_second


def region_boxes(regions: list[Region]) -> Array:
    """Boxes [x0, y0, x1, y1] (N, 4) of regions."""
    boxes = np.array([region.box for region in regions], dtype=float).reshape(-1, 4)
    return np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)


@dataclass(frozen=True, slots=True)
class Claims:
    """One claim (or none) a thing; which regions (R,) were given out, and which lie where a thing is (also unused)."""

    of: list[Claim | None]
    used: NDArray[np.bool_]
    near: NDArray[np.bool_]


def claim(regions: list[Region], reach: Array, join_share: float = np.inf) -> Claims:
    """Give regions to the things whose tangents are predicted as `reach` (T, K), one to one.

    Fragments inside one prediction are joined when the gap to its region is below `join_share` of that region's size;
    a region over several predictions is shared, each thing keeping only the tangents where it lies outermost.
    """
    used = np.zeros(len(regions), dtype=bool)
    of: list[Claim | None] = [None] * len(reach)
    if not len(regions) or not len(reach):
        return Claims(of, used, used.copy())
    boxes = region_boxes(regions)
    iou, inside, covered = overlap(boxes, boxes_of(reach))
    shared = np.sum(covered >= COVERED, axis=1) > 1
    belongs = ((inside >= INSIDE) | (covered >= COVERED) | (iou >= 0.2)) & ~shared[:, None]
    pairs, loose, _ = assign(np.where(belongs, 1 - iou, np.inf))
    parts = {int(thing): [int(r)] for r, thing in pairs}
    for r in (int(each) for each in loose):
        thing = int(np.argmax(inside[r]))
        if inside[r, thing] >= INSIDE and not shared[r] and thing in parts:
            main = boxes[parts[thing][0]]
            gap = np.max(np.maximum(main[:2] - boxes[r, 2:], boxes[r, :2] - main[2:]))
            if gap <= join_share * np.max(main[2:] - main[:2]):
                parts[thing].append(r)
    everywhere = np.ones(DIRECTIONS, dtype=bool)
    for thing, members in parts.items():
        of[thing] = Claim(region_tools.joined([regions[r] for r in members]), everywhere)
        used[members] = True
    for wide in np.flatnonzero(shared):
        r = int(wide)
        together = [int(each) for each in np.flatnonzero(covered[r] >= COVERED)]
        for thing in together:
            if of[thing] is None:
                others = np.max(reach[[other for other in together if other != thing]], axis=0)
                of[thing] = Claim(regions[r], reach[thing] > others + OWN_PX)
                used[r] = True
    return Claims(of, used, np.any((inside >= 0.3) | (covered >= COVERED), axis=1))


def footprint_contains(outer_pose: Array, outer_size: Array, point: Array) -> bool:
    """Whether a ground point (2,) lies inside a box's footprint."""
    offset = point - outer_pose[:2]
    c, s = np.cos(outer_pose[2]), np.sin(outer_pose[2])
    along, across = c * offset[0] + s * offset[1], -s * offset[0] + c * offset[1]
    return bool(abs(along) < outer_size[0] / 2 and abs(across) < outer_size[1] / 2)
