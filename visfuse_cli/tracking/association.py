"""Which region belongs to which watched candidate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.assignment import assign
from visfuse_cli.records import Array, Region

INSIDE = 0.6  # share of a region inside an expected box that makes it a part of that thing
COVERED = 0.5  # share of an expected box under one region that makes the thing a part of that region
LEAST_IOU = 0.2
INNER = np.array([[i, j] for i in (-0.4, -0.2, 0.0, 0.2, 0.4) for j in (-0.3, 0.0, 0.3)])  # of a length and a width
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


def footprint_overlap(pose: Array, size: Array, other_pose: Array, other_size: Array) -> Array:
    """How much (N, M) of the inner part of the smaller footprint lies in the larger one, of N boxes and M others.

    pose (N, 3), size (N, 3), other_pose (M, 3), other_size (M, 3): two things cannot stand in one place.
    """
    return shared_footprint(pose[:, None], size[:, None], other_pose, other_size)


def shared_footprint(pose: Array, size: Array, other_pose: Array, other_size: Array) -> Array:
    """`footprint_overlap` (...) of each box with the other in its place: poses and sizes (..., 3)."""
    ours = _covered(pose, size, other_pose, other_size)
    theirs = _covered(other_pose, other_size, pose, size)
    return np.maximum(ours, theirs)


def _covered(pose: Array, size: Array, other_pose: Array, other_size: Array) -> Array:
    """Share (...) of points spread over the inner part of footprints that lie in others."""
    c, s = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    along, across = INNER[:, 0] * size[..., :1], INNER[:, 1] * size[..., 1:2]
    x = pose[..., :1] + c * along - s * across - other_pose[..., :1]  # (..., P)
    y = pose[..., 1:2] + s * along + c * across - other_pose[..., 1:2]
    c, s = np.cos(other_pose[..., 2, None]), np.sin(other_pose[..., 2, None])
    inside = np.abs(c * x + s * y) < other_size[..., :1] / 2
    inside &= np.abs(-s * x + c * y) < other_size[..., 1:2] / 2
    return np.asarray(inside.mean(axis=-1))
