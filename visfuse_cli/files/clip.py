"""A video file as footage: PyAV, exact presentation stamps, damaged stretches survived."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.stream import Disposition

from visfuse_cli.errors import InputError
from visfuse_cli.files.timing import TimeAuditor, plural
from visfuse_cli.records import Image
from visfuse_cli.threads import thread_cap

# Silence, not a level: PyAV's log callback waits for the GIL in decoder threads, and closing a decoder deadlocks on it.
av.logging.set_level(None)

FULL_RANGE = 2  # AVColorRange JPEG
NO_TIMESTAMPS = 0x80  # AVFMT_NOTIMESTAMPS
CLOCK_SET = 1980  # a clock that was never set says 1904 or 1970
MAX_READ_FAILURES = 8
RIGHT_THEN = 1e-6  # s: a stamp and the same stamp as text
TURNS = {90: cv2.ROTATE_90_COUNTERCLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_CLOCKWISE}


@dataclass(frozen=True, slots=True)
class _Picture:
    """A decoded picture: I420 planes in one array (3 H / 2, W), or BGR already."""

    raw: Image
    packed: bool
    turn: int  # degrees counterclockwise, the container's display matrix

    def bgr(self) -> Image:
        # BT.601 for every clip: faster than the exact conversion, and the way back (video_writer) undoes it.
        image = np.asarray(cv2.cvtColor(self.raw, cv2.COLOR_YUV2BGR_I420), np.uint8) if self.packed else self.raw.copy()
        return np.asarray(cv2.rotate(image, TURNS[self.turn]), np.uint8) if self.turn else image


class Clip:
    """The first video stream of a file; raises InputError where it has none, or no frame or time can be read."""

    def __init__(self, path: Path, fps: float | None) -> None:
        self.path = path
        with self._opened() as (container, stream):
            first = list(islice(_decoded(container, stream, TimeAuditor(path.name)), 2))
            if not first:
                raise InputError(f"{path}: not one frame of it can be decoded")
            self._shape = (first[0].height, first[0].width)
            self._turn = round(first[0].rotation / 90) * 90 % 360
            self._stamped = first[0].pts is not None and not container.format.flags & NO_TIMESTAMPS
            self._tick = Fraction(first[0].time_base or stream.time_base or 1)
            self._first_pts = first[0].pts or 0
            self._interval = 1 / self._rate(stream, first, fps)
            self.nominal_rate = float(1 / self._interval)
            self.creation_time = _creation_time(stream.metadata) or _creation_time(container.metadata)
            self.resolution_s = float(self._tick) if self._stamped else 0.0
            self._frames, self._end_s = stream.frames, _announced_end(container, stream)
        height, width = self._shape
        self.width, self.height = (height, width) if self._turn % 180 else (width, height)
        self.announced = self._frames or (round(self._end_s * self.nominal_rate) if self._end_s else None)

    def pictures(self, auditor: TimeAuditor, start: float) -> Iterator[tuple[int, float, _Picture]]:
        """Every frame at or after `start` that can be decoded, in presentation order."""
        buffers = (self._buffer(), self._buffer())  # two: the picture before is still compared with
        index, t, longest = -1, -float(self._interval), 0.0
        damaged = interlaced = 0
        with self._opened() as (container, stream):
            for index, frame in enumerate(_decoded(container, stream, auditor)):
                before, t = t, self._time(frame, index, t)
                longest = max(longest, t - before)
                if t < start:
                    continue
                self._check_size(frame, index)
                damaged += bool(frame.is_corrupt)
                interlaced += bool(frame.interlaced_frame)
                yield index, t, _picture(frame, buffers[index % 2], self._turn)
        if damaged:
            auditor.warn(f"{plural(damaged, 'frame')} damaged in part")
        if interlaced:
            auditor.warn(f"{plural(interlaced, 'frame')} interlaced: odd and even rows show two instants")
        self._note_losses(auditor, index + 1, t, longest)

    def still(self, t: float) -> tuple[float, _Picture]:
        """The picture that is shown at `t` (s) and its own time, found from the key frame before it."""
        for seeking in (self._stamped and t > 0, False):
            with self._opened() as (container, stream):
                if seeking:
                    container.seek(self._first_pts + int(t / self._tick), stream=stream)
                shown: tuple[float, av.VideoFrame] | None = None
                for index, frame in enumerate(_decoded(container, stream, TimeAuditor(self.path.name))):
                    when = self._time(frame, index, shown[0] if shown else -float(self._interval))
                    if when > t + RIGHT_THEN and (shown or seeking):
                        break
                    shown = (when, frame)
                if shown is not None:
                    return shown[0], _picture(shown[1], self._buffer(), self._turn)
        raise InputError(f"{self.path}: no frame at {t:g} s can be decoded")

    def _time(self, frame: av.VideoFrame, index: int, before: float) -> float:
        """Seconds since the first stamp; a frame without one follows the frame before by the stated interval."""
        if not self._stamped:
            return float(index * self._interval)
        if frame.pts is None:
            return before + float(self._interval)
        ticks = frame.pts - self._first_pts
        return ticks * self._tick.numerator / self._tick.denominator  # of integers: correctly rounded

    def _rate(self, stream: av.VideoStream, first: list[av.VideoFrame], fps: float | None) -> Fraction:
        """Frames a second as stated; where stamps tell the times, those of the first two serve as well."""
        if self._stamped:
            announced = stream.average_rate or stream.guessed_rate
            ticks = (first[-1].pts or 0) - self._first_pts
            return announced or (1 / (ticks * self._tick) if ticks > 0 else Fraction(1))
        # The demuxer of a bare stream makes up 25 frames/s; only the coded pictures or the user state a rate.
        stated = stream.codec_context.framerate or fps
        if not stated:
            raise InputError(f"{self.path}: carries no times; set video.fps to its frame rate")
        return Fraction(stated).limit_denominator(10**6)

    def _check_size(self, frame: av.VideoFrame, index: int) -> None:
        if (frame.height, frame.width) != self._shape:
            was, now = f"{self._shape[1]}x{self._shape[0]}", f"{frame.width}x{frame.height}"
            raise InputError(f"{self.path}: frame {index} is {now} after {was}; cut the file where its size changes")

    def _buffer(self) -> Image:
        height, width = self._shape
        return np.empty((height * 3 // 2, width), np.uint8)

    def _note_losses(self, auditor: TimeAuditor, decoded: int, last: float, longest: float) -> None:
        """Frames announced but not there; an edit list may announce too many, so only where something is amiss."""
        interval = float(self._interval)
        behind = (self._end_s or 0.0) - (last + interval)
        tail = max(round(behind / interval), 0) if behind > 1.5 * max(interval, longest) else 0
        if not (tail or auditor.decode_errors):
            return
        lost = max(self._frames - decoded, 0) if self._frames else tail + auditor.decode_errors
        auditor.lose(min(tail, lost), inside=False)
        auditor.lose(max(lost - tail, 0), inside=True)

    @contextmanager
    def _opened(self) -> Iterator[tuple[Any, av.VideoStream]]:
        if not self.path.is_file():
            raise InputError(f"{self.path}: is not a file")
        if self.path.stat().st_size == 0:
            raise InputError(f"{self.path}: is empty")
        try:
            # "file:" and the whitelist: a name with a colon is no address, and a playlist inside opens nothing.
            container = av.open(f"file:{self.path}", options={"protocol_whitelist": "file"})
        except (av.error.FFmpegError, OSError) as problem:
            reason = problem.strerror or str(problem)
            raise InputError(f"{self.path}: cannot be read as a video: {reason}") from problem
        with container:
            streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]
            # Cover art and single images come as video streams too.
            if not streams or container.format.name.endswith("_pipe") or container.format.name == "image2":
                raise InputError(f"{self.path}: holds no video; give a video file or a folder of images")
            streams[0].thread_type = "AUTO"
            streams[0].codec_context.thread_count = thread_cap() or 0  # 0: one a core
            yield container, streams[0]


def _decoded(container: Any, stream: av.VideoStream, auditor: TimeAuditor) -> Iterator[av.VideoFrame]:
    """Every frame that can be decoded; a packet that cannot be read or decoded is counted and passed over."""
    packets = container.demux(stream)
    failures = 0  # one after another
    while failures < MAX_READ_FAILURES:
        try:
            packet = next(packets, None)
        except av.error.FFmpegError:
            auditor.decode_errors += 1
            failures += 1
            packets = container.demux(stream)
            continue
        if packet is None:
            return
        failures = 0
        try:
            yield from packet.decode()
        except av.error.FFmpegError:
            auditor.decode_errors += 1


def _picture(frame: av.VideoFrame, buffer: Image, turn: int) -> _Picture:
    height, width = frame.height, frame.width
    if frame.format.name != "yuv420p" or frame.color_range == FULL_RANGE or height % 2 or width % 2:
        return _Picture(np.asarray(frame.to_ndarray(format="bgr24"), np.uint8), packed=False, turn=turn)
    y, u, v = (np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size) for plane in frame.planes)
    buffer[:height] = y[:height, :width]  # a row of the plane is longer than the picture is wide
    chroma = buffer[height:].reshape(2, height // 2, width // 2)
    chroma[0], chroma[1] = u[: height // 2, : width // 2], v[: height // 2, : width // 2]
    return _Picture(buffer, packed=True, turn=turn)


def _announced_end(container: Any, stream: av.VideoStream) -> float | None:
    """Seconds of picture that the container announces; its whole length serves where no sound may be longer."""
    if stream.duration and stream.time_base:
        return float(stream.duration * stream.time_base)
    if container.duration and len(container.streams) == 1:
        # Matroska's length is the last stamp and not the time since the first one.
        before = max(container.start_time or 0, 0) if "matroska" in container.format.name else 0
        return float(container.duration - before) / av.time_base
    return None


def _creation_time(metadata: dict[str, str]) -> datetime | None:
    try:
        moment = datetime.fromisoformat(metadata.get("creation_time", ""))
    except ValueError:
        return None
    moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
    return moment if moment.year >= CLOCK_SET else None
