"""Adaptive background: which pixels moved, and a way to keep what is being followed out of the model."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np

from visfuse_cli.records import Array, Image

FOREGROUND, SHADOW = 255, 127
GROUPS = (0.9, 0.75, 0.6, 0.5, 0.4, 0.3)  # shares of a scene's pictures that may show the same
ALIKE = 16  # grey levels between the least and the largest of the same
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

    def start(self, picture: Image) -> None:
        """Begin from a picture (H, W, 3) of the empty scene."""
        self._model.apply(picture, learningRate=1.0)
        self._picture = picture.copy()

    def detect(self, image: Image) -> Image:
        """Label each pixel of `image` (H, W, 3): 255 foreground, 127 shadow, 0 background, without learning it."""
        return np.asarray(self._model.apply(image, learningRate=0.0), dtype=np.uint8)

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


def empty_picture(images: Iterable[Image]) -> Image:
    """The scene without its traffic: per pixel and channel, the middle of the values that most of the pictures share.

    The largest group of values that are alike is the road, also where vehicles cover it more than half of the time.
    """
    stack = np.stack(list(images))
    picture = np.empty(stack.shape[1:], np.uint8)
    rows = max(1, 4_000_000 // (stack.shape[0] * stack.shape[2] * 3))
    for top in range(0, stack.shape[1], rows):
        part = np.sort(stack[:, top : top + rows], axis=0)
        picture[top : top + rows] = _commonest(part.reshape(len(part), -1)).reshape(part.shape[1:])
    return picture


def _commonest(value: Image) -> Image:
    """The middle (m,) of the largest group of alike values in each column of `value` (n, m), sorted."""
    count = len(value)
    found = np.empty(value.shape[1], np.uint8)
    left = np.arange(value.shape[1])
    for share in GROUPS:
        held = max(1, round(share * count))
        width = value[held - 1 :] - value[: count - held + 1]
        first = np.argmin(width, axis=0)
        columns = np.arange(value.shape[1])
        found[left] = value[first + (held - 1) // 2, columns]
        loose = width[first, columns] > ALIKE
        if not loose.any():
            break
        value, left = value[:, loose], left[loose]
    return found
