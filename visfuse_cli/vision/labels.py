"""A picture of labels (background, shadow, foreground), small enough to keep seconds of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Image
from visfuse_cli.vision.background import FOREGROUND, SHADOW


class Labels:
    """One frame's labels (H, W); packed, a pixel takes two bits."""

    def __init__(self, picture: Image) -> None:
        self._picture: Image | None = picture
        self._width = picture.shape[1]
        self._bits: list[NDArray[np.uint8]] = []

    def pack(self) -> None:
        """Keep two bits a pixel from now on."""
        if self._picture is not None:
            self._bits = [np.packbits(part, axis=1) for part in (self._picture > 0, self._picture == FOREGROUND)]
            self._picture = None

    def picture(self) -> Image:
        """The whole picture (H, W)."""
        if self._picture is not None:
            return self._picture
        return _labelled(*(np.unpackbits(bits, axis=1, count=self._width) for bits in self._bits))

    def at(self, v: NDArray[np.intp], u: NDArray[np.intp]) -> NDArray[np.uint8]:
        """The labels (...) at rows v and columns u (...) of the picture; outside of it anything."""
        if self._picture is not None:
            return np.asarray(self._picture.take(v * self._width + u, mode="clip"))
        shift = (~u & 7).astype(np.uint8)
        place = v * self._bits[0].shape[1] + (u >> 3)
        return _labelled(*((bits.take(place, mode="clip") >> shift) & 1 for bits in self._bits))


def _labelled(moved: NDArray[np.uint8], paint: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return moved * np.uint8(SHADOW) + paint * np.uint8(FOREGROUND - SHADOW)
