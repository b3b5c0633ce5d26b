"""Shadows told from grey paint: by having no edge where there is no sun, and by their one darkness where there is."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from visfuse_cli.records import Array, Image
from visfuse_cli.vision.background import FOREGROUND, SHADOW

LIT = 128.0  # what a picture as light as the background is scaled to
SOFT = 7  # of these levels, across three pixels: an outline, also that of grey paint on a grey road, is a step
FADES = 0.15  # share of its rim along which a soft shadow fades into the ground; grey paint has an edge around it
LEARN_EVERY = 8  # frames
KEPT = 0.98  # of what is known of the darkness, each time it is learnt
ALIKE = 0.12  # of the darkness of shadows that shadows may differ by
AGREED, SURE_PX = 0.5, 2000.0  # share of what is seen that must be so dark, and how much must be seen
SETTLING = 4  # times that the median is taken of what is about as dark as the last one
SUNLIT = 0.75  # of the lit ground: where shadows are lighter the sun does not shine
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
SQUARE = np.ones((3, 3), np.uint8)


def lightness(grey: Image, empty: Image) -> Image:
    """How light a grey picture (H, W) is against that of the empty scene: LIT where it is as light."""
    return np.asarray(cv2.blur(cv2.divide(grey, empty, scale=LIT), (3, 3)), dtype=np.uint8)


def without_soft_shadows(labels: Image, light: Image) -> Image:
    """Labels (H, W) in which shadows that fade into the ground are background, by the `lightness`.

    Where there is no sun the ground darkens gradually towards a vehicle, so that colour alone tells no end of it.
    """
    shadow = cv2.compare(labels, SHADOW, cv2.CMP_EQ)
    if not cv2.hasNonZero(shadow):
        return labels
    steps = cv2.morphologyEx(light, cv2.MORPH_GRADIENT, SQUARE)
    soft = cv2.bitwise_and(shadow, cv2.compare(steps, SOFT, cv2.CMP_LE))
    count, piece = cv2.connectedComponents(soft, connectivity=4, ltype=cv2.CV_32S)
    outlines, _ = cv2.findContours(cv2.min(labels, 1), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    inside = cv2.drawContours(np.zeros_like(labels), outlines, -1, 255, cv2.FILLED)  # a hole in a body is no ground
    ground = cv2.dilate(cv2.bitwise_not(inside), CROSS)
    place = np.flatnonzero(soft > 0)
    of, outer = piece.ravel()[place], cv2.erode(soft, CROSS).ravel()[place] == 0
    around = np.bincount(of[outer], minlength=count)
    fading = np.bincount(of[outer & (ground.ravel()[place] > 0)], minlength=count)
    left = labels.copy()
    left.ravel()[place[(fading > FADES * around)[of]]] = 0
    return left


class Darkness:
    """How dark the shadows of a sunny scene are, learnt beside what is followed; all of them are equally so."""

    def __init__(self) -> None:
        self._seen = np.zeros(int(LIT), dtype=float)  # px of each lightness
        self._waiting = 0
        self._usual: float | None = None

    def learn(self, labels: Image, light: Image, followed: Iterable[Array]) -> None:
        """Take in the shadows of a labelled picture (H, W) outside of the outlines (k, 2) px of what is followed."""
        self._waiting += 1
        if self._waiting < LEARN_EVERY:
            return
        self._waiting = 0
        shadow = np.asarray(cv2.compare(labels, SHADOW, cv2.CMP_EQ), dtype=np.uint8)
        for hull in followed:
            cv2.fillConvexPoly(shadow, np.round(hull).astype(np.int32), 0)
        now = cv2.calcHist([light], [0], shadow, [int(LIT)], [0, LIT]).ravel()
        self._seen = KEPT * self._seen + now
        total = float(self._seen.sum())
        median, near = 0, slice(0, None)
        for _ in range(SETTLING):
            about = self._seen[near]
            median = (near.start or 0) + int(np.searchsorted(np.cumsum(about), about.sum() / 2))
            near = slice(round(median * (1 - ALIKE)), round(median * (1 + ALIKE)) + 1)
        alike = float(self._seen[near].sum())
        sunny = total > SURE_PX and alike > AGREED * total and median < SUNLIT * LIT
        self._usual = median if sunny else None

    @property
    def known(self) -> bool:
        """Whether the sun shines and it is known how dark it leaves its shadows."""
        return self._usual is not None

    def told(self, labels: Image, light: Image) -> Image:
        """Labels (H, W) in which what is taken for shadow and is not as dark as shadows are is foreground."""
        if self._usual is None:
            return labels
        alike = cv2.inRange(light, self._usual * (1 - ALIKE), self._usual * (1 + ALIKE))
        other = cv2.subtract(cv2.compare(labels, SHADOW, cv2.CMP_EQ), alike)
        paint = cv2.bitwise_or(other, cv2.compare(labels, FOREGROUND, cv2.CMP_EQ))
        other = cv2.bitwise_and(other, cv2.morphologyEx(paint, cv2.MORPH_OPEN, SQUARE))  # no rim of a shadow
        return np.asarray(cv2.max(labels, other), dtype=np.uint8)
