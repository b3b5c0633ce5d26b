"""What several pictures show alike: where in each one somebody can be, by what the other cameras see there."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import multiview
from visfuse_cli.records import Array, Image

STEP_M = 0.15  # side of the cells that the room about somebody is divided into
RADIUS_M, LOW_M, HIGH_M = 0.9, -0.12, 2.28  # of that room, about and above where somebody stands
CORNER = 0.7  # cells' sides from a cell's middle to its corners, as most pictures see them
BLOCK = 4  # px: side of the blocks in which they are drawn
AGAINST = 2  # cameras at least that must see nothing in a cell to call it empty: one may have its sight blocked


def _room() -> Array:
    line = np.arange(-RADIUS_M, RADIUS_M + STEP_M / 2, STEP_M)
    up = np.arange(LOW_M, HIGH_M, STEP_M) + STEP_M / 2
    cells = np.stack(np.meshgrid(line, line, up, indexing="ij"), axis=-1).reshape(-1, 3)
    return cells[np.hypot(cells[:, 0], cells[:, 1]) <= RADIUS_M]


ROOM = _room()


def backed(P: Array, masks: Mapping[int, Image], outside: Mapping[int, Image], feet: Array) -> list[dict[int, Array]]:
    """Boxes [u0, v0, u1, v1] (n, 4) px that cover, in each camera's picture, where people at feet (T, 3) m can be.

    masks (H, W) by camera of P (C, 3, 4) hold what moves, `outside` what a picture does not reach. A cell of the room
    counts for a picture unless most of the other cameras that hold it see nothing there. Where fewer than three cameras
    look, and where no cell is left, a picture is not limited: its camera is missing.
    """
    if len(masks) <= AGAINST or not len(feet):
        return [{} for _ in feet]
    cells = feet[:, None] + ROOM
    looks = [_look(P[camera], mask, outside[camera], cells) for camera, mask in masks.items()]
    holders, seers = (np.sum([look[k] for look in looks], axis=0) for k in (1, 2))
    found: list[dict[int, Array]] = [{} for _ in feet]
    for camera, (box, held, there) in zip(masks, looks, strict=True):
        others, against = holders - held, holders - held - (seers - there)
        good = there & ~((against >= AGAINST) & (2 * against > others))
        for who in np.flatnonzero(good.any(axis=1)):
            found[who][camera] = box[who, good[who]]
    return found


def _look(
    P: Array, mask: Image, outside: Image, cells: Array
) -> tuple[NDArray[np.intp], NDArray[np.bool_], NDArray[np.bool_]]:
    """The boxes (T, N, 4) px that cells (T, N, 3) fill in one picture, whether it holds them, and what moves there."""
    wide, high = mask.shape[1], mask.shape[0]
    x, y, depth = np.moveaxis(cells @ P[:, :3].T + P[:, 3], -1, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        u, v, half = x / depth, y / depth, CORNER * STEP_M * np.linalg.norm(P[0, :3]) / depth
        held = (depth > multiview.NEAREST) & (u > 0) & (u < wide - 1) & (v > 0) & (v < high - 1)
    u, v, half = (np.where(held, each, 0) for each in (u, v, half))
    held &= outside[v.astype(np.intp), u.astype(np.intp)] == 0
    u0, v0 = (np.maximum(each - half, 0).astype(np.intp) for each in (u, v))
    u1, v1 = np.minimum(u + half + 2, wide).astype(np.intp), np.minimum(v + half + 2, high).astype(np.intp)
    summed = cv2.integral(mask)
    count = summed[v1, u1] - summed[v0, u1] - summed[v1, u0] + summed[v0, u0]
    return np.stack([u0, v0, u1, v1], axis=-1), held, held & (count > 0)


def covered(boxes: Array, window: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    """Which pixels of a window [left, top, right, bottom] lie in one of the boxes (n, 4), to blocks of BLOCK px."""
    left, top, right, bottom = window
    wide, tall = -(-(right - left) // BLOCK), -(-(bottom - top) // BLOCK)
    u0, v0, u1, v1 = ((boxes - [left, top, left, top]) // BLOCK + [0, 0, 1, 1]).T
    u0, u1, v0, v1 = (np.clip(u, 0, most) for u, most in ((u0, wide), (u1, wide), (v0, tall), (v1, tall)))
    corners = np.concatenate([v0 * (wide + 1) + u0, v1 * (wide + 1) + u1, v0 * (wide + 1) + u1, v1 * (wide + 1) + u0])
    sign = np.repeat([1.0, 1.0, -1.0, -1.0], len(boxes))
    layers = np.bincount(corners, sign, (wide + 1) * (tall + 1)).reshape(tall + 1, wide + 1)
    blocks = layers.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0.5
    return blocks.repeat(BLOCK, axis=0)[: bottom - top].repeat(BLOCK, axis=1)[:, : right - left]
