"""A camera that sets its own exposure: pictures brought back to the brightness of a reference."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, Image

BLOCK = 16  # px: side of what is compared, so that a camera that shakes makes little difference
TOO_DARK, TOO_BRIGHT = 12, 243  # grey levels that say nothing about brightness
LEAST_SHARE = 0.05  # of the blocks must say something
SAME = 0.015  # a gain closer to 1 is none
NEAR, BINS = 0.05, np.linspace(-2, 2, 201)  # of the logarithm of a gain
STILL_SHARE = 0.15  # of the blocks that agree with the last gain keep it


class Exposure:
    """Compares pictures with a `reference` (H, W, 3) of the empty scene."""

    def __init__(self, reference: Image) -> None:
        self._reference = _blocks(reference)
        self._gain = np.ones(3)

    def gain(self, image: Image) -> Array:
        """What (3,) to multiply the channels of a picture with; exactly 1 where it is as bright as the reference.

        What most of the blocks say that agree with one another: shadows and vehicles may cover more than half of the
        picture, but the last gain stays as long as a part of it still agrees.
        """
        here = _blocks(image)
        usable = ((here > TOO_DARK) & (here < TOO_BRIGHT) & (self._reference > TOO_DARK)).all(axis=-1)
        if usable.mean() < LEAST_SHARE:
            return np.ones(3)
        ratio = np.log(self._reference[usable] / here[usable])
        green = ratio[:, 1]
        agree = np.abs(green - np.log(self._gain[1])) < NEAR
        if agree.mean() < STILL_SHARE:
            votes = np.convolve(np.histogram(green, BINS)[0], np.ones(5), mode="same")
            peak = int(np.argmax(votes))
            agree = np.abs(green - (BINS[peak] + BINS[peak + 1]) / 2) < NEAR
        if agree.mean() < STILL_SHARE:  # not the same place, or not quite: only the middle is left to go by
            agree[:] = True
        self._gain = np.exp(np.median(ratio[agree], axis=0).astype(float))
        return np.ones(3) if np.abs(self._gain - 1).max() < SAME else self._gain


def _blocks(image: Image) -> NDArray[np.float32]:
    """Means (h, w, 3) of the picture's blocks."""
    size = max(1, image.shape[1] // BLOCK), max(1, image.shape[0] // BLOCK)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def levelled(image: Image, gain: Array) -> Image:
    """The picture with its channels multiplied, saturated at 255; itself where the gain is 1."""
    if (gain == 1).all():
        return image
    return np.asarray(cv2.multiply(image, (*gain, 0)), dtype=np.uint8)
