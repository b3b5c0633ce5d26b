"""A picture of labels (background, shadow, foreground), small enough to keep seconds of them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Image
from visfuse_cli.vision.background import FOREGROUND, SHADOW


class Labels:
    """One frame's labels (H, W); packed, a pixel takes two bits."""

    def __init__(self, picture: Image) -> None:
        self._picture: Image | None = picture
        self._shape = picture.shape
        self._bits: list[NDArray[np.uint8]] = []

    def pack(self) -> None:
        """Keep two bits a pixel from now on."""
        if self._picture is not None:
            moved, paint = cv2.compare(self._picture, 0, cv2.CMP_GT), cv2.compare(self._picture, FOREGROUND, cv2.CMP_EQ)
            self._bits = [np.packbits(np.asarray(part, np.uint8)) for part in (moved, paint)]
            self._picture = None

    def picture(self) -> Image:
        """The whole picture (H, W)."""
        if self._picture is not None:
            return self._picture
        high, wide = self._shape
        return _labelled(*(np.unpackbits(bits, count=high * wide) for bits in self._bits)).reshape(high, wide)

    def at(self, place: NDArray[np.intp]) -> NDArray[np.uint8]:
        """The labels (...) at places (...) of the picture, row after row; outside of it anything."""
        if self._picture is not None:
            return np.asarray(self._picture.take(place, mode="clip"))
        byte, shift = place >> 3, (~place & 7).astype(np.uint8)
        return _labelled(*(bits.take(byte, mode="clip") >> shift & np.uint8(1) for bits in self._bits))


def _labelled(moved: NDArray[np.uint8], paint: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return moved * np.uint8(SHADOW) + paint * np.uint8(FOREGROUND - SHADOW)
