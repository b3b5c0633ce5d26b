"""Adaptive background: which pixels moved, and a way to keep what is being followed out of the model."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from visfuse_cli.records import Array, Image

FOREGROUND, SHADOW = 255, 127


class Background:
    """OpenCV's MOG2 or KNN model with looking and learning apart (Lou 2002, sec. 2, motion detection).

    `horizon_s` is the memory in seconds; every `learn_every`-th frame is learnt, with the pixels of live tracks
    replaced by the background itself, so that a car that waits at a light does not dissolve into the road.
    """

    def __init__(self, kind: str, threshold: float, shadow_ratio: float, learn_every: int) -> None:
        if kind == "mog2":
            model = cv2.createBackgroundSubtractorMOG2(500, threshold, True)
        else:
            model = cv2.createBackgroundSubtractorKNN(500, threshold * 25, True)
        model.setShadowValue(SHADOW)
        model.setShadowThreshold(shadow_ratio)
        self._model = model
        self._learn_every = learn_every
        self._seen = 0
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
        self._seen += 1
        if self._picture is None or self._seen % self._learn_every:
            return
        rate = 1 - (1 - rate) ** self._learn_every
        hulls = [np.round(hull).astype(np.int32) for hull in followed]
        if hulls:
            mask = np.zeros(image.shape[:2], np.uint8)
            for hull in hulls:
                cv2.fillConvexPoly(mask, hull, 255)
            image = image.copy()
            cv2.copyTo(self._picture, mask, image)
        self._model.apply(image, learningRate=rate)
        self._picture = cv2.addWeighted(image, max(rate, 1 / 64), self._picture, 1 - max(rate, 1 / 64), 0)


def median_picture(images: Iterable[Image]) -> Image:
    """The per-pixel median of a few pictures of one scene: what stood still through most of them."""
    stack = np.stack(list(images))
    rows = max(1, 4_000_000 // (stack.shape[0] * stack.shape[2] * 3))
    picture = np.empty(stack.shape[1:], np.uint8)
    for top in range(0, stack.shape[1], rows):
        picture[top : top + rows] = np.median(stack[:, top : top + rows], axis=0)
    return picture
