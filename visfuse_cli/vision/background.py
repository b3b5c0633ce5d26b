"""Adaptive background: which pixels moved, and a way to keep what is being followed out of the model."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np

from visfuse_cli.records import Array, Image

FOREGROUND, SHADOW = 255, 127
BINS = 64  # of the ratio of a pixel to the background, from 0 to 1
SHADOW_REACH = 4  # bins either side of the shadows' own ratio: sensor noise and texture
SUN_LIMIT = 0.8  # shadows of the sun are darker than this
DARKER_SHARE, LIGHTER_SHARE = 0.2, 0.7  # of all shadow pixels within reach, to call darker or lighter ones paint
SHADOW_MEMORY = 0.995  # a frame: clouds come and go
LEARN_EVERY = 4  # frames: learning costs as much as looking


class Background:
    """OpenCV's MOG2 or KNN model with looking and learning apart (Lou 2002, sec. 2, motion detection).

    Every few frames one is learnt, with the pixels of live tracks replaced by the background itself, so that a car
    that waits at a light does not dissolve into the road.
    """

    def __init__(self, kind: str, threshold: float, shadow_ratio: float) -> None:
        model: Any
        if kind == "mog2":
            model = cv2.createBackgroundSubtractorMOG2(500, threshold, True)
        else:
            model = cv2.createBackgroundSubtractorKNN(500, threshold * 25, True)
        model.setShadowValue(SHADOW)
        model.setShadowThreshold(shadow_ratio)
        self._model = model
        self._waiting = 0  # frames since the last one that was learnt
        self._share = 0.0
        self._picture: Image | None = None
        self._shadows = _ShadowDepth()

    def start(self, picture: Image) -> None:
        """Begin from a picture (H, W, 3) of the empty scene."""
        self._model.apply(picture, learningRate=1.0)
        self._picture = picture.copy()

    def detect(self, image: Image) -> Image:
        """Label each pixel of `image` (H, W, 3): 255 foreground, 127 shadow, 0 background, without learning it."""
        labels = np.asarray(self._model.apply(image, learningRate=0.0), dtype=np.uint8)
        if self._picture is not None:
            pass  # self._shadows.relabel(labels, image, self._picture)
        return labels

    def learn(self, image: Image, rate: float, followed: Iterable[Array]) -> None:
        """Adapt to `image` by `rate` (share a frame) except inside the followed outlines (k, 2) px."""
        self._waiting += 1
        self._share += rate
        if self._picture is None or self._waiting < LEARN_EVERY:
            return
        rate, self._waiting, self._share = min(self._share, 1.0), 0, 0.0
        hulls = [np.round(hull).astype(np.int32) for hull in followed]
        if hulls:
            mask = np.zeros(image.shape[:2], np.uint8)
            for hull in hulls:
                cv2.fillConvexPoly(mask, hull, 255)
            image = image.copy()
            cv2.copyTo(self._picture, mask, image)
        self._model.apply(image, learningRate=rate)
        self._picture = cv2.addWeighted(image, max(rate, 1 / 64), self._picture, 1 - max(rate, 1 / 64), 0)


class _ShadowDepth:
    """How dark this recording's cast shadows are: one sun casts them all, they share one ratio to the lit ground.

    Where that ratio stands out, what is darker is no shadow but a tyre, a bumper or dark paint, and where nearly all
    shadow has it, what is lighter is grey paint.
    """

    def __init__(self) -> None:
        self._histogram = np.zeros(BINS)

    def relabel(self, labels: Image, image: Image, picture: Image) -> None:
        """Turn `labels` from shadow to foreground where the darkening is not the shadows' own."""
        at = np.nonzero(labels == SHADOW)
        if not len(at[0]):
            return
        lit = np.maximum(picture[at].sum(axis=1, dtype=np.int32), 1)
        level = np.minimum(image[at].sum(axis=1, dtype=np.int32) * BINS // lit, BINS - 1)
        self._histogram = SHADOW_MEMORY * self._histogram + np.bincount(level, minlength=BINS)
        near = np.convolve(self._histogram, np.ones(2 * SHADOW_REACH + 1), mode="same") / self._histogram.sum()
        modes = (near[1:-1] >= near[:-2]) & (near[1:-1] >= near[2:]) & (near[1:-1] > DARKER_SHARE)
        modes[int(SUN_LIMIT * BINS) :] = False
        if not modes.any():
            return  # the even light of a cloudy sky: no ratio stands out
        peak = int(np.flatnonzero(modes)[-1]) + 1  # the lightest: tyres and bumpers are darker than shadows
        share = near[peak]
        paint = level < peak - SHADOW_REACH
        if share > LIGHTER_SHARE:
            paint |= level > peak + SHADOW_REACH
        labels[at[0][paint], at[1][paint]] = FOREGROUND


def median_picture(images: Iterable[Image]) -> Image:
    """The per-pixel median of a few pictures of one scene: what stood still through most of them."""
    stack = np.stack(list(images))
    rows = max(1, 4_000_000 // (stack.shape[0] * stack.shape[2] * 3))
    picture = np.empty(stack.shape[1:], np.uint8)
    for top in range(0, stack.shape[1], rows):
        picture[top : top + rows] = np.median(stack[:, top : top + rows], axis=0)
    return picture
