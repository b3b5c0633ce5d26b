"""Which cameras hold a person in their picture, and which of them have a clear sight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.maths import multiview, people
from visfuse_cli.records import Array, Gaussian, Image

HIDDEN = 0.3  # share of a person behind another from which on the sight is not clear


def standing(beliefs: Gaussian, height: Array, config: FuseConfig) -> Array:
    """Where the feet of people (T,) with these heights are (T, 3) m."""
    foot = beliefs.mean[:, :3].copy()
    if config.fusion.point == "centroid":
        foot[:, 2] -= height / 2
    return foot


def expected_boxes(P: Array, foot: Array, height: Array, width: Array) -> Array:
    """Boxes [u0, v0, u1, v1] (T, C, 4) px in which cameras P (C, 3, 4) see people that stand at (T, 3)."""
    return people.boxes(P, people.outline(foot, height, width)[:, None])


def visibility(
    beliefs: Gaussian, size: Array, P: Array, config: FuseConfig, outside: list[Image] | None = None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which cameras' pictures, sizes (C, 2) px, hold each person's middle (T, C), and which show it whole (T, C).

    `outside` (H, W) is, for each camera, where its picture does not reach.
    """
    count = len(beliefs.mean)
    usual = np.full(count, config.person.height)
    foot = standing(beliefs, usual, config)
    box = expected_boxes(P, foot, usual, np.full(count, config.person.width))
    with np.errstate(invalid="ignore"):
        middle = (box[..., :2] + box[..., 2:]) / 2
        inside = np.all((middle > 0) & (middle < size - 1), axis=-1)
        whole = inside & np.all((box[..., :2] > 0) & (box[..., 2:] < size - 1), axis=-1)
    for camera, blank in enumerate(outside or []):
        if blank.any():
            inside[:, camera] &= ~_blank(blank, middle[:, camera])
            for corner in ([0, 1], [2, 1], [0, 3], [2, 3]):
                whole[:, camera] &= ~_blank(blank, box[:, camera, corner])
    return inside, whole & ~(hidden_share(box, multiview.depths(P, foot[:, None])).max(axis=1, initial=0.0) > HIDDEN)


def _blank(outside: Image, pixels: Array) -> NDArray[np.bool_]:
    """Which pixels (T, 2) a picture does not reach; those beyond its frame are left to others."""
    size = np.array(outside.shape[::-1])
    u, v = np.clip(np.nan_to_num(pixels), 0, size - 1).astype(np.intp).T
    return np.asarray(outside[v, u] > 0)


def hidden_share(box: Array, depth: Array) -> Array:
    """Share (T, T, C) of each person's box (T, C, 4) that lies behind each other's; depth (T, C) m."""
    low = np.maximum(box[:, None, :, :2], box[None, :, :, :2])
    high = np.minimum(box[:, None, :, 2:], box[None, :, :, 2:])
    area = np.prod(np.maximum(box[..., 2:] - box[..., :2], 1e-9), axis=-1)
    share = np.prod(np.clip(high - low, 0, None), axis=-1) / area[:, None]
    return np.where(depth[None] < depth[:, None], np.nan_to_num(share), 0.0)
