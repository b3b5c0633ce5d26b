"""Dense optical flow, and what of it the camera's own motion explains."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Image

MEAN = np.array([[1, 2, 1], [2, 0, 2], [1, 2, 1]], np.float32) / 12
SMALLEST = 24  # px: side of the coarsest level
WARPS = 3  # linearisations a level


def horn_schunck(before: Image, after: Image, smoothness: float, iterations: int, sigma: float) -> Array:
    """Flow (H, W, 2) px from one grey picture (H, W) to the next, coarse to fine. Jia 2008, sec. 2.

    The classic scheme sees motions of about a pixel; halves of the pictures bring larger ones down to that.
    """
    pair = [
        cv2.GaussianBlur(grey.astype(np.float32), (0, 0), sigma) if sigma > 0 else grey.astype(np.float32)
        for grey in (before, after)
    ]
    levels = [pair]
    while min(levels[-1][0].shape) >= 2 * SMALLEST:
        levels.append([cv2.pyrDown(grey) for grey in levels[-1]])
    flow = np.zeros((*levels[-1][0].shape, 2), np.float32)
    for first, second in reversed(levels):
        size = (first.shape[1], first.shape[0])
        if flow.shape[:2] != first.shape:
            flow = 2 * cv2.resize(flow, size, interpolation=cv2.INTER_LINEAR)
        u, v = np.meshgrid(np.arange(size[0], dtype=np.float32), np.arange(size[1], dtype=np.float32))
        for _ in range(WARPS):
            base = flow
            moved = cv2.remap(
                second, u + base[..., 0], v + base[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            middle = (first + moved) / 2
            gx, gy = (cv2.Sobel(middle, cv2.CV_32F, *axis, ksize=3, scale=1 / 8) for axis in ((1, 0), (0, 1)))
            gt = moved - first
            below = smoothness**2 + gx**2 + gy**2
            for _ in range(max(iterations // WARPS, 1)):
                mean = cv2.filter2D(flow, -1, MEAN, borderType=cv2.BORDER_REPLICATE)
                off = mean - base
                share = (gx * off[..., 0] + gy * off[..., 1] + gt) / below
                flow = mean - share[..., None] * np.stack([gx, gy], axis=-1)
    return np.asarray(flow, dtype=float)


def dis(before: Image, after: Image) -> Array:
    """Flow (H, W, 2) px between grey pictures (H, W) by dense inverse search: fast, for larger pictures."""
    finder = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)  # type: ignore[attr-defined]
    return np.asarray(finder.calc(before, after, None), dtype=float)


def own_motion(depth: Array, K: Array, R: Array, t: Array) -> Array:
    """Flow (H, W, 2) px that the camera's motion gives static points at `depth` (H, W) m; NaN where it is unknown.

    R (3, 3), t (3,) m lead from the camera before to the one after: x' = R x + t. Where the depth is infinite only
    the turning counts.
    """
    high, wide = depth.shape
    u, v = np.meshgrid(np.arange(wide, dtype=float), np.arange(high, dtype=float))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    moved = rays @ R.T + t / depth[..., None]
    with np.errstate(invalid="ignore", divide="ignore"):
        seen = moved[..., :2] / np.where(moved[..., 2:] > 1e-6, moved[..., 2:], np.nan)
    return np.stack([seen[..., 0] * K[0, 0] + K[0, 2] - u, seen[..., 1] * K[1, 1] + K[1, 2] - v], axis=-1)
