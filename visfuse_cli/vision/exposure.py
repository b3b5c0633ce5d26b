"""A camera that sets its own exposure: pictures brought back to the brightness of a reference."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Image

STRIDE = 8  # every so many pixels are compared, across and down
TOO_DARK, TOO_BRIGHT = 12, 243  # grey levels that say nothing about brightness
LEAST_SHARE = 0.05  # of the compared pixels must say something
SAME = 0.015  # a gain closer to 1 is none


class Exposure:
    """Compares pictures with a `reference` (H, W, 3) of the empty scene."""

    def __init__(self, reference: Image) -> None:
        self._reference = np.ascontiguousarray(reference[::STRIDE, ::STRIDE]).astype(np.float32)

    def gain(self, image: Image) -> Array:
        """What (3,) to multiply the channels of a picture with; exactly 1 where it is as bright as the reference.

        The median over the picture: what moves covers less than half of it.
        """
        here = image[::STRIDE, ::STRIDE]
        usable = (here > TOO_DARK) & (here < TOO_BRIGHT) & (self._reference > TOO_DARK)
        if usable.all(axis=-1).mean() < LEAST_SHARE:
            return np.ones(3)
        ratio = np.where(usable, self._reference / np.maximum(here, 1), np.nan)
        gain = np.nanmedian(ratio.reshape(-1, 3), axis=0).astype(float)
        return np.ones(3) if np.abs(gain - 1).max() < SAME else gain


def levelled(image: Image, gain: Array) -> Image:
    """The picture with its channels multiplied, saturated at 255; itself where the gain is 1."""
    if (gain == 1).all():
        return image
    table = np.clip(np.rint(np.arange(256)[:, None] * gain), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(image, table[:, None, :]), dtype=np.uint8)
