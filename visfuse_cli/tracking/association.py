"""Which region belongs to which watched candidate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.assignment import assign
from visfuse_cli.records import Array, Region
from visfuse_cli.vision import regions as region_tools

INSIDE = 0.6  # share of a region inside an expected box that makes it a part of that thing
COVERED = 0.5  # share of an expected box under one region that makes the thing a part of that region
LEAST_IOU = 0.2
FRAGMENT_GAP = 0.25  # of a region's size: parts of one vehicle lie closer together, two vehicles mostly apart


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


def claim(regions: list[Region], expected: Array) -> tuple[list[Region | None], NDArray[np.bool_]]:
    """Give regions to the things expected in boxes [x0, y0, x1, y1] (T, 4), one to one; and which were given out.

    Fragments inside one box are joined when they lie close together; a region over several boxes is given to none.
    """
    used = np.zeros(len(regions), dtype=bool)
    given: list[Region | None] = [None] * len(expected)
    if not len(regions) or not len(expected):
        return given, used
    boxes = region_boxes(regions)
    iou, inside, covered = overlap(boxes, expected)
    shared = np.sum(covered >= COVERED, axis=1) > 1
    belongs = ((inside >= INSIDE) | (covered >= COVERED) | (iou >= LEAST_IOU)) & ~shared[:, None]
    pairs, loose, _ = assign(np.where(belongs, 1 - iou, np.inf))
    parts = {int(thing): [int(r)] for r, thing in pairs}
    for r in (int(each) for each in loose):
        thing = int(np.argmax(inside[r]))
        if inside[r, thing] >= INSIDE and not shared[r] and thing in parts:
            main = boxes[parts[thing][0]]
            gap = np.max(np.maximum(main[:2] - boxes[r, 2:], boxes[r, :2] - main[2:]))
            if gap <= FRAGMENT_GAP * np.max(main[2:] - main[:2]):
                parts[thing].append(r)
    for thing, members in parts.items():
        given[thing] = region_tools.joined([regions[r] for r in members])
        used[members] = True
    return given, used


def footprint_contains(outer_pose: Array, outer_size: Array, point: Array) -> bool:
    """Whether a ground point (2,) lies inside a box's footprint."""
    offset = point - outer_pose[:2]
    c, s = np.cos(outer_pose[2]), np.sin(outer_pose[2])
    along, across = c * offset[0] + s * offset[1], -s * offset[0] + c * offset[1]
    return bool(abs(along) < outer_size[0] / 2 and abs(across) < outer_size[1] / 2)
