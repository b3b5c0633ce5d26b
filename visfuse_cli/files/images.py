"""A folder of images as footage: natural order, times from timestamps.csv or from a stated rate."""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.atomic import replacing
from visfuse_cli.files.folders import IMAGE_SUFFIXES, list_files
from visfuse_cli.files.timing import TimeAuditor
from visfuse_cli.records import Image

STAMPS = "timestamps.csv"
DEPTH_SAMPLES = 32  # images that tell how many bits of 16 are in use


@dataclass(frozen=True, slots=True)
class _Picture:
    raw: Image

    def bgr(self) -> Image:
        return self.raw.copy()


class ImageFolder:
    """Images of one size; a damaged one is lost and keeps its index. Raises InputError without images or times."""

    creation_time: datetime | None = None

    def __init__(self, folder: Path, fps: float | None) -> None:
        self.names = list_files(folder, IMAGE_SUFFIXES)
        if not self.names:
            raise InputError(f"{folder}: no images in this folder ({', '.join(sorted(IMAGE_SUFFIXES))})")
        stamps = folder / STAMPS
        if stamps.exists():
            self.stamps, self.extra_stamps = _read_stamps(stamps, len(self.names))
            self.nominal_rate = _rate(self.stamps)
        elif fps is not None:
            self.stamps, self.extra_stamps = array("d", (k / fps for k in range(len(self.names)))), 0
            self.nominal_rate = fps
        else:
            raise InputError(
                f"{folder}: images carry no times; set video.fps, or put a {STAMPS} (columns frame,t) beside them"
            )
        self.announced: int | None = len(self.names)
        self.resolution_s = 0.0
        first = next((image for name in self.names if (image := _load(name)) is not None), None)
        if first is None:
            raise InputError(f"{folder}: none of its {len(self.names)} images can be decoded")
        self.height, self.width = first.shape[:2]
        self.scale = self._sixteen_bit_scale() if first.dtype == np.uint16 else 255 / 65535

    def pictures(self, auditor: TimeAuditor, start: float) -> Iterator[tuple[int, float, _Picture]]:
        """Every readable image at or after `start`; raises InputError where one has another size."""
        auditor.lose(self.extra_stamps, inside=False)
        for index, (name, t) in enumerate(zip(self.names, self.stamps, strict=True)):
            if t < start:
                continue
            image = _load(name)
            if image is None:
                auditor.lose(1, inside=True)
                auditor.warn(f"{name.name} cannot be decoded")
                continue
            height, width = image.shape[:2]
            if (width, height) != (self.width, self.height):
                raise InputError(f"{name}: is {width}x{height}, the folder's other images {self.width}x{self.height}")
            yield index, t, _Picture(image if image.dtype == np.uint8 else self._to_eight_bit(image))

    def _to_eight_bit(self, image: np.ndarray) -> Image:
        return np.asarray(cv2.convertScaleAbs(image, alpha=self.scale), np.uint8)

    def _sixteen_bit_scale(self) -> float:
        """255 over the full scale of the bits in use (10, 12, 14, ... of 16), one for the whole folder."""
        chosen = np.unique(np.linspace(0, len(self.names) - 1, DEPTH_SAMPLES).astype(int))
        samples = (_load(self.names[k]) for k in chosen)
        brightest = max(int(image.max()) for image in samples if image is not None)
        return 255 / (2 ** max(brightest.bit_length(), 8) - 1)


def write_image(path: Path, image: Image) -> None:
    """Write a picture (H, W, 3) BGR as PNG; raises OutputError where it cannot be written."""
    with replacing(path) as file:
        file.write(cv2.imencode(".png", image)[1].tobytes())


def _load(name: Path) -> np.ndarray | None:
    """An image (H, W, 3) BGR of 8 or 16 bits, or None where it cannot be decoded; raises InputError on other depths."""
    try:
        data = np.fromfile(name, np.uint8)
    except OSError as problem:
        raise InputError(f"{name}: cannot be read: {problem.strerror}") from problem
    image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH) if len(data) else None
    if image is not None and image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{name}: holds {image.dtype} pixels; 8 or 16 bit integers are read")
    return image


def _read_stamps(path: Path, images: int) -> tuple[array[float], int]:
    """Times from the first one (s), one an image, and how many more rows there are than images; raises InputError."""
    stamps = array("d")
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file)
            missing = {"frame", "t"} - set(rows.fieldnames or ())
            if missing:
                raise InputError(f"{path}: line 1: no column {' and '.join(sorted(missing))}; the header is frame,t")
            for row in rows:
                stamps.append(_stamp(row, stamps, f"{path}: line {rows.line_num}"))
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise InputError(f"{path}: cannot be read as CSV: {problem}") from problem
    if len(stamps) < images:
        raise InputError(f"{path}: {len(stamps)} rows for {images} images; give one row an image")
    return array("d", (t - stamps[0] for t in stamps[:images])), len(stamps) - images


def _stamp(row: dict[str, str | None], before: array[float], where: str) -> float:
    try:
        frame, t = int(row["frame"] or ""), float(row["t"] or "")
    except ValueError as problem:
        raise InputError(f"{where}: frame '{row['frame']}', t '{row['t']}': a whole number and seconds") from problem
    if not math.isfinite(t):
        raise InputError(f"{where}: t '{row['t']}': a finite number of seconds")
    if frame != len(before):
        raise InputError(f"{where}: frame {frame} where {len(before)} was expected: one row an image, in order, from 0")
    if before and t < before[-1]:
        raise InputError(f"{where}: t = {t:g} comes before the row above ({before[-1]:g}); times must rise")
    return t


def _rate(stamps: array[float]) -> float:
    intervals = [b - a for a, b in pairwise(stamps) if b > a]
    return 1 / float(np.median(intervals)) if intervals else 1.0
