"""The scene without its traffic, from pictures of it with traffic."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, Image

BLOCK = 4  # px: side of the places in which the empty scene is sought
ALIKE = 6  # grey levels a channel between two sights of a place
SURE = 0.5  # share of the pictures that show what is the scene without doubt
UNLIKE = 20.0  # grey levels from the surroundings that make a colour e times less likely
AROUND, NEAR = (24.0, 6.0), 0.2  # blocks that surroundings reach, wide and near, and the share of them that is enough
LIT, SAME_HUE = (
    (1.2, 2.4),
    12.0,
)  # times as bright as its shadow is the lit ground, and grey levels of its colour off that
SAME_RATIO = 0.05  # of that ratio's logarithm
BESIDE, FEW = 6.0, 0.05  # blocks: what is seen that close in one picture is in the same light
LIT_TOGETHER = 0.1  # share of what lies beside a place that must be seen more often when it is lit than when not
NIGHT = 45  # grey levels: half of a scene at night is darker, and what is brighter in it is lit by lamps
LIT_SHARE = 0.06  # of the pictures in which a place is that much brighter, to take what is seen more often for shadow


def empty_picture(images: Sequence[Image], moved_px: float = 0.0, neighbours: bool = True) -> Image:
    """The scene without its traffic, from pictures (H, W, 3) in the order of time.

    In each small block the empty scene is the colour that is seen often and over the longest time; where no colour is
    seen in half of the pictures, or where it may be a shadow's, one like the surroundings is preferred: windows and
    tyres come back as well, and a queue casts its shadow for long. The picture is the mean of those that show it.
    `moved_px` is how far a place may have moved between two pictures, as it does where shake was compensated.
    Without `neighbours`, what is seen beside a place in the same picture does not count: a vehicle that comes straight
    at the camera covers its place and all that lies beside it in most of a short recording.
    """
    high, wide = images[0].shape[:2]
    coarse = (-(-wide // BLOCK), -(-high // BLOCK))
    blocks = np.stack([cv2.resize(image, coarse, interpolation=cv2.INTER_AREA) for image in images])
    alike = _tolerance(blocks, moved_px)
    shows = _recurring(blocks, np.ones(blocks.shape[:3], np.float32), alike)
    often = shows.sum(axis=0)
    colour = np.einsum("nvu,nvuc->vuc", shows.astype(np.float32), blocks.astype(np.float32)) / often[..., None]
    lit, shaded = _lit(blocks, colour)
    in_shadow = np.count_nonzero(lit, axis=0) >= np.maximum(
        max(2, LIT_SHARE * len(images)), np.count_nonzero(shaded, axis=0)
    )
    sure = (often >= SURE * len(images)) & ~in_shadow
    if not sure.all():
        around = _surroundings(colour, sure.astype(np.float32))
        off, dark_off = _off(blocks, around.astype(np.float32)), _off(colour, around)
        in_light = in_shadow & (_mean(off, lit) < dark_off + UNLIKE)
        shows[:, in_light] = lit[:, in_light]
        beside = _shown_beside(shows, sure | in_light)
        # paint on the road is like no surroundings: it is lit when what lies beside it is
        in_light |= in_shadow & (_mean(beside, lit) > _mean(beside, shows) + LIT_TOGETHER)
        shows[:, in_light] = lit[:, in_light]
        left = ~(sure | in_light)
        if left.any():
            likely = np.exp(-off[:, None, left] / UNLIKE)
            weight = beside[:, None, left] if neighbours else None
            shows[:, left] = _recurring(blocks[:, None, left], likely, alike[None, left], weight)[:, 0]
    total, count = np.zeros((high, wide, 3), np.float32), np.zeros((high, wide), np.float32)
    for image, shown in zip(images, shows, strict=True):
        mask = cv2.resize(shown.astype(np.uint8), (wide, high), interpolation=cv2.INTER_NEAREST)
        cv2.accumulate(image, total, mask)
        count += mask
    return np.asarray(np.rint(total / count[..., None]), dtype=np.uint8)


def _off(colours: NDArray[Any], others: Array | Iterable[Array]) -> Array:
    """How far apart (...) colours (..., 3) are in the channel in which that is most; the others may come by channel."""
    channels = np.moveaxis(others, -1, 0) if isinstance(others, np.ndarray) else others
    apart = (np.abs(colours[..., k] - channel) for k, channel in enumerate(channels))
    return reduce(np.maximum, apart)


def _tolerance(blocks: Image, moved_px: float) -> Image:
    """Grey levels (h, w) by which two sights of a block may differ: more where a shift changes it."""
    middle = np.median(blocks[:: max(1, len(blocks) // 7)], axis=0).astype(np.float32)
    slopes = [np.abs(cv2.Sobel(middle, cv2.CV_32F, *axis)).max(axis=-1) / 8 / BLOCK for axis in ((1, 0), (0, 1))]
    return np.asarray(np.minimum(ALIKE + moved_px * np.hypot(*slopes), 3 * ALIKE), dtype=np.uint8)


def _mean(values: NDArray[Any], which: NDArray[np.bool_]) -> Array:
    """Mean (h, w) of the chosen ones of n values (n, h, w)."""
    return np.asarray(np.where(which, values, 0).sum(axis=0) / np.maximum(which.sum(axis=0), 1))


def _shown_beside(shows: NDArray[np.bool_], sure: NDArray[np.bool_]) -> NDArray[np.float32]:
    """How much (n, h, w), 0 to 1, of the sure blocks (h, w) about each one shows the scene in each of n pictures."""
    known = sure.astype(np.float32)
    whole = cv2.GaussianBlur(known, (0, 0), BESIDE) + 2 * FEW
    return np.stack([(cv2.GaussianBlur(shown * known, (0, 0), BESIDE) + FEW) / whole for shown in shows])


def _recurring(
    blocks: Image, likely: NDArray[np.float32], tolerance: Image, weight: NDArray[np.float32] | None = None
) -> NDArray[np.bool_]:
    """Which of n pictures of blocks (n, h, w, 3) show the colour that comes back over the longest time.

    What is seen before and after something else was there is behind it: the time counts more than how often.
    `likely` (n, h, w) is how likely each colour is to be the scene's before that, `tolerance` (h, w) in grey levels.
    """
    count, high, wide, _ = blocks.shape
    channels = np.ascontiguousarray(blocks.reshape(count, -1, 3).transpose(2, 0, 1))
    best, shows = np.zeros(high * wide, np.float32), np.zeros((count, high * wide), bool)
    for tried in range(count):
        apart = np.zeros(shows.shape, np.uint8)
        for channel in channels:
            np.maximum(apart, cv2.absdiff(channel, np.broadcast_to(channel[tried], channel.shape)), out=apart)
        alike = apart <= tolerance.reshape(1, -1)
        span = count - alike[::-1].argmax(axis=0) - alike.argmax(axis=0)
        value = (
            (alike.sum(axis=0) if weight is None else np.einsum("np,np->p", alike, weight.reshape(count, -1)))
            * span
            * likely[tried].ravel()
        )
        better = value > best
        best[better], shows[:, better] = value[better], alike[:, better]
    return shows.reshape(count, high, wide)


def _lit(blocks: Image, colour: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which blocks (n, h, w, 3) are as much brighter than a colour (h, w, 3) as the light is than its shadow, and which
    as much darker.

    How much that is, is the same everywhere under one sun, and not known before: it is what is seen most often.
    """
    length = np.maximum(np.sum(colour**2, axis=-1), 1.0)
    ratio = np.einsum("nvuc,vuc->nvu", blocks, colour) / length
    off = _off(blocks, (ratio * colour[..., channel] for channel in range(3)))
    brighter = (ratio > LIT[0]) & (ratio < LIT[1]) & (off < SAME_HUE)
    if not brighter.any() or np.median(colour) < NIGHT:
        return np.zeros_like(brighter), np.zeros_like(brighter)
    count, edges = np.histogram(np.log(ratio[brighter]), bins=int(np.log(LIT[1] / LIT[0]) / SAME_RATIO))
    usual = (edges[np.argmax(count)] + edges[np.argmax(count) + 1]) / 2
    log = np.log(np.maximum(ratio, 1e-9))
    darker = (np.abs(log + usual) < 1.5 * SAME_RATIO) & (off < SAME_HUE)
    return brighter & (np.abs(log - usual) < 1.5 * SAME_RATIO), darker


def _surroundings(colour: Array, sure: NDArray[np.float32]) -> Array:
    """The colour (h, w, 3) of the sure blocks (h, w) about each one, from further away where none is near."""
    found = colour
    for reach in AROUND:
        weight = cv2.GaussianBlur(sure, (0, 0), reach)[..., None]
        here = cv2.GaussianBlur(colour * sure[..., None], (0, 0), reach) / np.maximum(weight, 1e-6)
        near = np.clip(weight / NEAR, 0, 1)
        found = here if reach == AROUND[0] else near * here + (1 - near) * found
    return np.asarray(found, dtype=float)
