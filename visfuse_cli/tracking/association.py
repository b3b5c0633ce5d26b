"""Which region belongs to which watched candidate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.assignment import assign
from visfuse_cli.records import Array, Region

INSIDE = 0.6  # share of a region inside an expected box that makes it a part of that thing
COVERED = 0.5  # share of an expected box under one region that makes the thing a part of that region
LEAST_IOU = 0.2
YOUNGER = 0.1  # of overlap: what the first of the expected things is given before the last


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


def claim(regions: list[Region], expected: Array) -> NDArray[np.intp]:
    """Which region (T,) belongs to each of the things expected in boxes [x0, y0, x1, y1] (T, 4), one to one; -1: none.

    Where several would do, the thing that comes first has the better claim.
    """
    given = np.full(len(expected), -1)
    if len(regions) and len(expected):
        iou, inside, covered = overlap(region_boxes(regions), expected)
        belongs = (inside >= INSIDE) | (covered >= COVERED) | (iou >= LEAST_IOU)
        younger = YOUNGER * np.arange(len(expected)) / len(expected)
        pairs, _, _ = assign(np.where(belongs, 1 - iou + younger, np.inf))
        given[pairs[:, 1]] = pairs[:, 0]
    return given


def footprint_contains(outer_pose: Array, outer_size: Array, point: Array) -> bool:
    """Whether a ground point (2,) lies inside a box's footprint."""
    offset = point - outer_pose[:2]
    c, s = np.cos(outer_pose[2]), np.sin(outer_pose[2])
    along, across = c * offset[0] + s * offset[1], -s * offset[0] + c * offset[1]
    return bool(abs(along) < outer_size[0] / 2 and abs(across) < outer_size[1] / 2)
