"""Normal flow: the motion along the grey values' gradient, all that one place shows, and regions grown from it."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Image

LEAST_GRADIENT = 6.0  # grey levels a pixel: below, noise makes any flow
WEAK = 0.5  # of the seeds' flow: how far a region grows
CLOSED = 9  # px: gaps within a thing that are closed
FEWEST, ROUNDS = 200, 8  # px that can tell a shift, and rounds of doing so


def normal_flow(before: Image, after: Image, sigma: float) -> tuple[Array, Array]:
    """Normal flow (H, W, 2) px between grey pictures (H, W), -E_t grad E / |grad E|^2, and |grad E| (H, W).

    Bradshaw 1997, sec. 2. sigma (px) smooths both pictures first.
    """
    first, second = (cv2.GaussianBlur(grey.astype(np.float32), (0, 0), max(sigma, 0.5)) for grey in (before, after))
    middle = (first + second) / 2
    gx, gy = (cv2.Sobel(middle, cv2.CV_32F, *axis, ksize=3, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    square = gx**2 + gy**2
    share = -(second - first) / np.maximum(square, 1e-6)
    return np.asarray(np.stack([share * gx, share * gy], axis=-1), dtype=float), np.asarray(
        np.sqrt(square), dtype=float
    )


def turned(before: Image, R: Array, K: Array) -> tuple[Image, Image]:
    """The picture before as the camera would see it after turning by R (3, 3), x' = R x; and where it is known."""
    H = K @ R @ np.linalg.inv(K)
    size = (before.shape[1], before.shape[0])
    seen = cv2.warpPerspective(before, H, size, flags=cv2.INTER_LINEAR)
    known = cv2.warpPerspective(np.full(before.shape[:2], 255, np.uint8), H, size, flags=cv2.INTER_NEAREST)
    return np.asarray(seen, np.uint8), np.asarray(cv2.erode(known, np.ones((5, 5), np.uint8)), np.uint8)


def steadied(flow: Array, gradient: Array, known: Image) -> Array:
    """Normal flow (H, W, 2) px less the shift that most of the picture agrees on: what angles are off by."""
    usable = (gradient > LEAST_GRADIENT) & (known > 0)
    v = flow[usable]
    size = np.linalg.norm(v, axis=1)
    if len(v) < FEWEST:
        return flow
    unit = v / np.maximum(size, 1e-9)[:, None]
    shift, weight = np.zeros(2), np.ones(len(v))
    for _ in range(ROUNDS):
        W = unit * weight[:, None]
        shift = np.linalg.solve(W.T @ unit + 1e-6 * np.eye(2), W.T @ size)
        off = np.abs(size - unit @ shift)
        scale = max(1.4826 * float(np.median(off)), 1e-3)
        weight = 1 / (1 + (off / (2 * scale)) ** 2) ** 2
    direction = flow / np.maximum(np.linalg.norm(flow, axis=-1, keepdims=True), 1e-9)
    return np.asarray(flow - (direction @ shift)[..., None] * direction)


def grown(speed: Array, gradient: Array, known: Image, least: float) -> list[tuple[Array, int]]:
    """Boxes [u0, v0, u1, v1] and areas (px) of regions that grow from normal flow (H, W) of `least` px or more."""
    usable = (gradient > LEAST_GRADIENT) & (known > 0)
    seeds = (usable & (speed > least)).astype(np.uint8)
    weak = (usable & (speed > WEAK * least)).astype(np.uint8)
    weak = cv2.morphologyEx(weak, cv2.MORPH_CLOSE, np.ones((CLOSED, CLOSED), np.uint8))
    weak = cv2.morphologyEx(weak, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, parts, blobs, _ = cv2.connectedComponentsWithStats(weak)
    counts = np.bincount(parts[seeds > 0], minlength=len(blobs))
    return [
        (np.array([x - 0.5, y - 0.5, x + w - 0.5, y + h - 0.5], dtype=float), int(area))
        for (x, y, w, h, area), seen in zip(blobs[1:], counts[1:], strict=True)
        if seen > 0.15 * area
    ]
