"""The paper's background: every pixel a Kalman filter whose noise adapts (Lou 2002, sec. 2)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Image

LEAST_VAR, MOST_VAR, FIRST_VAR = 4.0, 75.0, 15.0  # grey levels^2 a channel: noise of a picture
FIRST_SHARE = 0.125  # of that noise: the doubt of a picture to begin from, which is the mean of many
JOINING = 4.0  # times the usual gain: how fast what has come to stand joins the background
NOISE_RATE = 0.05  # share of the noise that one picture renews
MEAN = np.full((1, 3), 1 / 3, np.float32)  # over the channels
FOREGROUND = 255


class KalmanBackground:
    """Colour of the empty scene as a random walk, with the interface of OpenCV's subtractors.

    Where a picture fits the background the gain is the filter's own, P / (P + R), and R follows the innovations; where
    it does not, a small constant gain lets what has stopped become part of the background.
    """

    def __init__(self, threshold: float) -> None:
        self._threshold = threshold
        self._shadow, self._shadow_value = 0.5, 127
        self._colour: NDArray[np.float32] | None = None  # (H, W, 3)
        self._noise = self._doubt = np.zeros((0, 0), np.float32)  # R and P (H, W)
        self._shown: Image = np.zeros((0, 0, 3), np.uint8)
        self._limit = np.zeros((0, 0), np.uint16)

    def setShadowValue(self, value: int) -> None:
        """The label of a shadow."""
        self._shadow_value = value

    def setShadowThreshold(self, share: float) -> None:
        """How dark a shadow may be, as a share of the lit ground."""
        self._shadow = share

    def apply(self, image: Image, learningRate: float) -> Image:
        """Label a picture (H, W, 3) and learn it at a rate (0: not at all; 1: begin from it)."""
        if self._colour is None or learningRate >= 1:
            self._begin(image)
        labels = self._labelled(image)
        if 0 < learningRate < 1:
            self._learn(image, labels, learningRate)
        return labels

    def _begin(self, image: Image) -> None:
        self._colour = image.astype(np.float32)
        self._noise = np.full(image.shape[:2], FIRST_VAR, np.float32)
        self._doubt = FIRST_SHARE * self._noise
        self._settle()

    def _labelled(self, image: Image) -> Image:
        far = cv2.absdiff(image, self._shown)
        squares = cv2.split(cv2.multiply(far, far, dtype=cv2.CV_16U))
        distance = cv2.add(cv2.add(squares[0], squares[1]), squares[2])  # saturates, far beyond every limit
        labels = np.asarray(cv2.compare(distance, self._limit, cv2.CMP_GT), dtype=np.uint8)
        v, u = np.nonzero(labels)
        seen, lit = image[v, u].astype(np.float32), self._shown[v, u].astype(np.float32)
        share = np.einsum("nc,nc->n", seen, lit) / np.maximum(np.einsum("nc,nc->n", lit, lit), 1)
        aside = seen - share[:, None] * lit
        same_colour = np.einsum("nc,nc->n", aside, aside) < self._limit[v, u] * share**2
        shade = (share >= self._shadow) & (share <= 1) & same_colour
        labels[v[shade], u[shade]] = self._shadow_value
        return labels

    def _learn(self, image: Image, labels: Image, rate: float) -> None:
        assert self._colour is not None
        innovation = cv2.subtract(image, self._colour, dtype=cv2.CV_32F)
        square = cv2.transform(cv2.multiply(innovation, innovation), MEAN)
        prior = self._doubt + rate**2 * self._noise  # a walk whose steady gain is the rate
        gain = prior / (prior + self._noise)
        moved = labels > 0
        gain[moved] = min(1.0, JOINING * rate)
        self._colour = np.asarray(cv2.add(self._colour, cv2.multiply(innovation, cv2.merge([gain] * 3))))
        self._doubt = np.where(moved, prior, (1 - gain) * prior)
        found = np.clip(square - prior, LEAST_VAR, MOST_VAR)
        cv2.accumulateWeighted(found, self._noise, NOISE_RATE, cv2.compare(labels, 0, cv2.CMP_EQ))
        self._settle()

    def _settle(self) -> None:
        """What looking needs, from what was learnt."""
        assert self._colour is not None
        self._shown = np.asarray(cv2.convertScaleAbs(self._colour), dtype=np.uint8)
        limit = cv2.addWeighted(self._noise, self._threshold, self._doubt, self._threshold, 0)
        self._limit = np.minimum(limit, 65535).astype(np.uint16)
