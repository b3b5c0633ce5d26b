"""Single pictures of footage, by time: of a clip, of a folder of images, or the one picture of an image file."""

from __future__ import annotations

from bisect import bisect_right
from pathlib import Path

import cv2
import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.clip import RIGHT_THEN, Clip
from visfuse_cli.files.folders import is_folder
from visfuse_cli.files.images import ImageFolder
from visfuse_cli.files.timing import TimeAuditor
from visfuse_cli.records import Image


class Stills:
    """Footage to look at: size (w, h) px, duration s (0: one picture only), the time between frames s.

    Raises InputError where it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._image = read_image_file(path)
        self._clip = None if self._image is not None or is_folder(path) else Clip(path, fps=1.0)
        self._folder = ImageFolder(path, fps=1.0) if is_folder(path) else None
        if self._image is not None:
            self.size, self.interval, self.duration = (self._image.shape[1], self._image.shape[0]), 1.0, 0.0
            return
        reader = self._clip or self._folder
        assert reader is not None
        self.size, self.interval = (reader.width, reader.height), 1 / reader.nominal_rate
        self.duration = max((reader.announced or 1) - 1, 0) * self.interval
        if self._folder is not None:
            self.duration = self._folder.stamps[-1]

    def at(self, t: float) -> tuple[float, Image]:
        """The frame that is shown at `t` (s), 8-bit BGR, and its own time; the last one after the end."""
        if self._image is not None:
            return 0.0, self._image
        if self._clip is not None:
            when, picture = self._clip.still(t)
            return when, picture.bgr()
        assert self._folder is not None
        shown = max(bisect_right(self._folder.stamps, t + RIGHT_THEN) - 1, 0)
        for _, when, image in self._folder.pictures(TimeAuditor(self.path.name), self._folder.stamps[shown]):
            return when, image.bgr()
        raise InputError(f"{self.path}: no image from {t:g} s on can be decoded")


def read_image_file(path: Path) -> Image | None:
    """A picture as 8-bit BGR, None where the file is no picture; raises InputError where it is a damaged one."""
    try:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() and cv2.haveImageReader(str(path)) else None
    except cv2.error as problem:
        raise InputError(f"{path}: not a readable picture") from problem
    return None if image is None else np.asarray(image, dtype=np.uint8)
