"""Dense optical flow, and what of it the camera's own motion explains."""

from __future__ import annotations

from functools import lru_cache

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
            moved = cv2.remap(
                second, u + flow[..., 0], v + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            middle = (first + moved) / 2
            gx, gy = (cv2.Sobel(middle, cv2.CV_32F, *axis, ksize=3, scale=1 / 8) for axis in ((1, 0), (0, 1)))
            gt = moved - first
            flow = _smoothed(flow, gx, gy, gt, smoothness, max(iterations // WARPS, 1))
    return np.asarray(flow, dtype=float)


def _smoothed(flow: Array, gx: Array, gy: Array, gt: Array, smoothness: float, rounds: int) -> Array:
    """Flow (H, W, 2) after some rounds of the scheme of Horn and Schunck, from one linearisation."""
    below = 1 / (smoothness**2 + gx**2 + gy**2)
    ax, ay = gx * below, gy * below
    u, v = (np.ascontiguousarray(flow[..., k]) for k in (0, 1))
    rest = gt - gx * u - gy * v
    mu, mv, share, part = (np.empty_like(u) for _ in range(4))
    for _ in range(rounds):
        cv2.filter2D(u, -1, MEAN, mu, borderType=cv2.BORDER_REPLICATE)
        cv2.filter2D(v, -1, MEAN, mv, borderType=cv2.BORDER_REPLICATE)
        np.multiply(gx, mu, out=share)
        share += np.multiply(gy, mv, out=part)
        share += rest
        np.subtract(mu, np.multiply(ax, share, out=part), out=u)
        np.subtract(mv, np.multiply(ay, share, out=part), out=v)
    return np.stack([u, v], axis=-1)


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
    rays = _rays(high, wide, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    nearness = (1 / depth).astype(np.float32)
    x, y, z = (
        rays[0] * row[0] + rays[1] * row[1] + (nearness * shift + row[2])
        for row, shift in zip(R.astype(np.float32), t.astype(np.float32), strict=True)
    )
    z = np.where(z > 1e-6, z, np.nan)
    return np.stack([(x / z - rays[0]) * np.float32(K[0, 0]), (y / z - rays[1]) * np.float32(K[1, 1])], axis=-1)


@lru_cache(maxsize=4)
def _rays(high: int, wide: int, fx: float, fy: float, cx: float, cy: float) -> tuple[Array, Array]:
    """Across and down (1, W) and (H, 1) of the rays through all pixels at unit depth."""
    across, down = (np.arange(wide) - cx) / fx, (np.arange(high) - cy) / fy
    return across[None].astype(np.float32), down[:, None].astype(np.float32)
