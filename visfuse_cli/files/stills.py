"""Single pictures of footage, by time: of a clip, of a folder of images, or the one picture of an image file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.clip import Clip
from visfuse_cli.files.folders import is_folder
from visfuse_cli.files.video import open_source
from visfuse_cli.records import Image


class Stills:
    """Footage to look at: size (w, h) px, duration s (0: one picture only), the time between frames s.

    Raises InputError where it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._image = read_image_file(path)
        self._clip = None if self._image is not None or is_folder(path) else Clip(path, fps=1.0)
        if self._image is not None:
            self.size, self.interval, self.duration = (self._image.shape[1], self._image.shape[0]), 1.0, 0.0
            return
        source = open_source(path, fps=1.0)
        self.size, self.interval = (source.width, source.height), 1 / source.nominal_rate
        self.duration = max((source.frame_count or 1) - 1, 0) * self.interval

    def at(self, t: float) -> tuple[float, Image]:
        """The frame that is shown at `t` (s), 8-bit BGR, and its own time; the last one after the end."""
        if self._image is not None:
            return 0.0, self._image
        if self._clip is not None:
            when, picture = self._clip.still(t)
            return when, picture.bgr()
        with open_source(self.path, fps=1.0, start=min(t, self.duration)) as source:
            frame = next(iter(source.frames()))
            return frame.t, frame.image


def read_image_file(path: Path) -> Image | None:
    """A picture as 8-bit BGR, None where the file is no picture; raises InputError where it is a damaged one."""
    try:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() and cv2.haveImageReader(str(path)) else None
    except cv2.error as problem:
        raise InputError(f"{path}: not a readable picture") from problem
    return None if image is None else np.asarray(image, dtype=np.uint8)
