"""Footage in: video files and image folders behind one face, with exact times."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Protocol

from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.clip import Clip
from visfuse_cli.files.folders import describe, is_clip_folder, is_folder, list_clips
from visfuse_cli.files.images import ImageFolder
from visfuse_cli.files.timing import TimeAuditor
from visfuse_cli.records import Frame, Image, TimeAudit

__all__ = ["VideoSource", "describe", "is_clip_folder", "list_clips", "open_source"]

SPARSE = 16  # every so many rows are compared before all of them are


class Picture(Protocol):
    """One decoded picture, not yet converted."""

    @property
    def raw(self) -> Image:
        """The decoded bytes, for comparison; nobody else writes to them."""

    def bgr(self) -> Image:
        """The picture (H, W, 3) BGR, in memory of its own."""


class Reader(Protocol):
    """One kind of footage: what is known on opening, and its pictures as (index, stamp from the first one, picture)."""

    width: int
    height: int
    nominal_rate: float  # frames/s, as announced, or from the first stamps
    creation_time: datetime | None  # UTC
    announced: int | None  # frames
    resolution_s: float  # of the stamps

    def pictures(self, auditor: TimeAuditor, start: float) -> Iterator[tuple[int, float, Picture]]:
        """Decode from the beginning, leave out what is before `start` (s); losses and oddities go to the auditor."""


class VideoSource:
    """One opened clip: size, rate and creation time at once, frames in presentation order on demand.

    Every call of `frames` decodes from the beginning, in the thread that iterates; frames outside [start, end) keep
    their index and are not converted.
    """

    def __init__(self, path: Path, reader: Reader, camera: str, start: float | None, end: float | None) -> None:
        self.path, self.camera, self.start, self.end = path, camera, start, end
        self.width, self.height = reader.width, reader.height
        self.nominal_rate = reader.nominal_rate
        self.creation_time = reader.creation_time
        self.frame_count = _count_within(reader, start, end)  # an estimate, or None
        self._reader = reader
        self._auditor = TimeAuditor(path.name)
        self._open: list[Generator[Frame, None, None]] = []

    def __enter__(self) -> VideoSource:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        for frames in self._open:
            with suppress(ValueError):  # still running in another thread, which ends it
                frames.close()
        self._open.clear()

    def frames(self, every: int = 1) -> Iterator[Frame]:
        """The frames within [start, end), times rising; raises InputError where there is none, or none is readable.

        With `every` only the first of each so many is converted and yielded; repeated pictures are then not told.
        """
        frames = self._frames(every)
        self._open.append(frames)
        return frames

    def audit(self) -> TimeAudit:
        """What the last reading found out about the times and losses of the frames it yielded."""
        return self._auditor.result()

    def _frames(self, every: int) -> Generator[Frame, None, None]:
        auditor = self._auditor = TimeAuditor(self.path.name, self._reader.resolution_s)
        repeats = _RepeatDetector()
        last = -math.inf
        backward = within = 0
        for index, t, picture in self._reader.pictures(auditor, -math.inf if self.start is None else self.start):
            if self.end is not None and t >= self.end:
                break
            if t <= last:  # shown for no time at all; dt = 0 measures nothing
                backward += t < last
                auditor.duplicated += t == last
                continue
            last = t
            auditor.add(t)
            within += 1
            if (within - 1) % every:
                continue
            auditor.duplicated += every == 1 and repeats.repeats(picture.raw)
            yield Frame(self.camera, index, t, picture.bgr())
        if backward:
            auditor.warn(f"{backward} frames are stamped before the frame they follow and were left out")
        if last == -math.inf:
            raise InputError(f"{self.path}: no frame between --start and --end: the footage ends before {self.start} s")


class _RepeatDetector:
    """Tells whether a picture equals the one before in every byte."""

    def __init__(self) -> None:
        self._before: Image | None = None

    def repeats(self, raw: Image) -> bool:
        before, self._before = self._before, raw
        if before is None or before.shape != raw.shape:
            return False
        return bool((before[::SPARSE] == raw[::SPARSE]).all() and (before == raw).all())


def _count_within(reader: Reader, start: float | None, end: float | None) -> int | None:
    if reader.announced is None:
        return None
    first = math.ceil((start or 0) * reader.nominal_rate)
    last = reader.announced if end is None else min(reader.announced, math.ceil(end * reader.nominal_rate))
    return max(last - first, 0)


def open_source(
    path: str | Path,
    *,
    fps: float | None = None,
    start: float | None = None,
    end: float | None = None,
    camera: str = "image",
) -> VideoSource:
    """Open a video file or a folder of images; `fps` serves footage without time stamps, start and end are seconds.

    Raises InputError where it is missing, unreadable or without times, UsageError where start and end hold nothing.
    """
    path = Path(path)
    _check_window(start, end)
    if is_folder(path):
        reader: Reader = ImageFolder(path, fps)
    else:
        reader = Clip(path, fps)
    return VideoSource(path, reader, camera, start, end)


def _check_window(start: float | None, end: float | None) -> None:
    for option, value in (("--start", start), ("--end", end)):
        if value is not None and not (math.isfinite(value) and value >= 0):
            raise UsageError(f"{option} {value}: seconds of footage, 0 or more")
    if start is not None and end is not None and start >= end:
        raise UsageError(f"--start {start:g} is not before --end {end:g}")
    if end == 0:
        raise UsageError("--end 0: no frame is shown before the first one; give a time after 0")
