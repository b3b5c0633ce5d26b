"""Adaptive background: which pixels moved, and a way to keep what is being followed out of the model."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, Image
from visfuse_cli.vision.ghosts import find_ghosts
from visfuse_cli.vision.kalman_background import KalmanBackground

FOREGROUND, SHADOW = 255, 127
NOISE = 3.0  # grey levels a channel, of what a picture and its background may differ by where a ghost was
STILL_S = 1.0  # s that a ghost stands before it is looked for
KNN_FIRST, KNN_LOOKING = (0.5,) * 10, 1e-9  # rates: it fills its samples one by one, and divides by the logarithm
MIXTURES = 3  # of MOG2 in each pixel: a place seldom has more than two looks, and each takes time to read
LEARN_EVERY = 4  # frames: learning costs as much as looking


class Background:
    """The adaptive Kalman model, OpenCV's MOG2 or KNN, with looking and learning apart (Lou 2002, sec. 2).

    Every few frames one is learnt, with the pixels of live tracks replaced by the background itself, so that a car
    that waits at a light does not dissolve into the road.
    """

    def __init__(self, kind: str, threshold: float, shadow_ratio: float, memory_s: float) -> None:
        model: Any
        self._first: tuple[float, ...]  # rates at which the first picture is learnt
        if kind == "mog2":
            model, self._first = cv2.createBackgroundSubtractorMOG2(500, threshold, True), (1.0,)
            model.setNMixtures(MIXTURES)
        elif kind == "kalman":
            model, self._first = KalmanBackground(threshold), (1.0,)
        else:
            model, self._first = cv2.createBackgroundSubtractorKNN(500, threshold * 25, True), KNN_FIRST
        self._looking = KNN_LOOKING if kind == "knn" else 0.0
        model.setShadowValue(SHADOW)
        model.setShadowThreshold(shadow_ratio)
        self._model = model
        self._farthest = 3 * threshold * NOISE**2
        self._memory_s = memory_s
        self._waiting = 0  # frames since the last one that was learnt
        self._learnt_t = 0.0
        self._picture: Image | None = None
        self._grey: Image | None = None
        self._mean: NDArray[np.float32]  # the picture before it is rounded: it changes by less than a grey level
        self._labels: Image | None = None
        self._corrected: Image | None = None  # 255 where a ghost was taken out of the picture; the model learns slowly
        self._compared: tuple[float, Image, Image] | None = None  # t, grey picture and labels when ghosts were sought

    def start(self, picture: Image) -> None:
        """Begin from a picture (H, W, 3) of the empty scene."""
        for rate in self._first:
            self._model.apply(picture, learningRate=rate)
        self._picture, self._grey = picture.copy(), None
        self._corrected = self._compared = None
        self._mean = picture.astype(np.float32)

    @property
    def picture(self) -> Image:
        """The scene without what moves (H, W, 3), as far as it is known."""
        assert self._picture is not None
        return self._picture

    @property
    def grey(self) -> Image:
        """The picture in grey (H, W)."""
        if self._grey is None:
            self._grey = np.asarray(cv2.cvtColor(self.picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        return self._grey

    def detect(self, image: Image) -> Image:
        """Label each pixel of `image` (H, W, 3): 255 foreground, 127 shadow, 0 background, without learning it."""
        self._labels = np.asarray(self._model.apply(image, learningRate=self._looking), dtype=np.uint8)
        if self._corrected is not None and self._picture is not None:
            found = cv2.findNonZero(cv2.bitwise_and(self._labels, self._corrected))
            if found is not None:
                u, v = found.reshape(-1, 2).T
                far = image[v, u].astype(np.int32) - self._picture[v, u]
                alike = np.sum(far**2, axis=1) < self._farthest
                self._labels[v[alike], u[alike]] = 0
        return self._labels

    def learn(self, image: Image, t: float, followed: Iterable[Array], labels: Image | None = None) -> None:
        """Adapt to `image` (H, W, 3) at t (s), except inside the followed outlines (k, 2) px.

        `labels` are what `detect` said of it; None: it is the one looked at last.

        A thing that the background holds and that is no longer there is taken out of it at once.
        """
        self._waiting += 1
        if self._picture is None or self._waiting < LEARN_EVERY:
            return
        rate = float(np.clip((t - self._learnt_t) / self._memory_s, 0, 1))
        self._waiting, self._learnt_t = 0, t
        self._forget_ghosts(image, t, self._labels if labels is None else labels)
        hulls = [np.round(hull).astype(np.int32) for hull in followed]
        if hulls:
            mask = np.zeros(image.shape[:2], np.uint8)
            for hull in hulls:
                cv2.fillConvexPoly(mask, hull, 255)
            image = image.copy()
            cv2.copyTo(self._picture, mask, image)
        self._model.apply(image, learningRate=rate)
        cv2.accumulateWeighted(image, self._mean, rate)
        self._picture, self._grey = np.asarray(cv2.convertScaleAbs(self._mean), dtype=np.uint8), None

    def _forget_ghosts(self, image: Image, t: float, now: Image | None) -> None:
        if self._compared is not None and t - self._compared[0] < STILL_S:
            return
        assert self._picture is not None
        assert now is not None
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if self._compared is not None:
            _, earlier, then = self._compared
            moved = cv2.compare(cv2.bitwise_and(now, then), FOREGROUND, cv2.CMP_EQ)
            gone = find_ghosts(grey, earlier, moved, now, self.grey)
            if gone.any():
                self._picture = np.asarray(cv2.copyTo(image, gone, self._picture.copy()), np.uint8)  # somebody may look
                self._mean[gone > 0] = image[gone > 0]
                self._corrected = gone if self._corrected is None else cv2.bitwise_or(self._corrected, gone)
        self._compared = t, grey, now
