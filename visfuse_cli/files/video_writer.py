"""H.264 in mp4 that a browser plays, with the times it was given."""

from __future__ import annotations

from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import cv2
import numpy as np

from visfuse_cli.errors import OutputError
from visfuse_cli.files.atomic import replacing_path
from visfuse_cli.records import Image
from visfuse_cli.threads import thread_cap

# A third of mp4v's size at a better picture and 1.7 times its speed (measured, 720p).
PRESET, QUALITY = "ultrafast", "26"
CLOCK = 90_000  # ticks a second
KEYFRAME_S = 2  # how far a player jumps
BT601, LIMITED = 6, 1  # AVColorSpace SMPTE170M, AVColorRange MPEG: what cv2's conversion makes

BEGINS = "begins in the footage at "


class VideoWriter:
    """`with VideoWriter(path, width, height) as video:` writes pictures (height, width, 3) BGR uint8 at their times.

    The video begins with its first picture, since browsers misjudge the length of one that begins later; `begin_of`
    tells when in the footage that was.
    The file appears under its name when the block ends, an interruption (KeyboardInterrupt) included; on any other
    exception, and without a single picture, there is none. An odd size grows by one pixel, repeated from the border.
    Raises OutputError where it cannot be written.
    """

    def __init__(self, path: str | Path, width: int, height: int, rate: float = 30.0) -> None:
        self.path = Path(path)
        self.size = (height, width)
        self._rate = Fraction(rate).limit_denominator(1001)
        self._last = -1
        self._first = 0
        self._closing = ExitStack()

    def __enter__(self) -> VideoWriter:
        partial = self._closing.enter_context(replacing_path(self.path))
        try:
            self._container = av.open(str(partial), "w", format="mp4", options={"movflags": "faststart"})
            self._stream = self._add_stream()
        except (av.error.FFmpegError, OSError) as problem:
            self._closing.__exit__(type(problem), problem, problem.__traceback__)
            raise self._refusal(problem) from problem
        return self

    def _add_stream(self) -> av.VideoStream:
        height, width = self.size
        stream = self._container.add_stream("libx264", rate=self._rate)
        stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, CLOCK)
        stream.codec_context.gop_size = max(1, round(KEYFRAME_S * self._rate))
        stream.codec_context.color_range, stream.codec_context.colorspace = LIMITED, BT601
        stream.codec_context.thread_count = thread_cap() or 0  # 0: as x264 sees fit
        stream.options = {"preset": PRESET, "crf": QUALITY}
        return stream

    def write(self, image: Image, t: float) -> None:
        """Append one picture at `t` (s); raises ValueError where the size differs or `t` does not rise."""
        if image.shape[:2] != self.size:
            raise ValueError(f"{self.path}: a picture of {image.shape[:2]}, where {self.size} was announced")
        pts = round(t * CLOCK)
        if pts <= self._last:
            raise ValueError(f"{self.path}: t = {t} does not come after {self._last / CLOCK}")
        height, width = self.size
        if height % 2 or width % 2:
            image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        planes = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420), np.uint8)
        frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
        if self._last < 0:
            self._first = pts
            self._container.metadata["comment"] = f"{BEGINS}{pts / CLOCK:.6f} s"
        frame.pts, frame.time_base = pts - self._first, Fraction(1, CLOCK)
        self._last = pts
        try:
            self._container.mux(self._stream.encode(frame))
        except (av.error.FFmpegError, OSError) as problem:
            raise self._refusal(problem) from problem

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        keep = self._last >= 0 and (kind is None or issubclass(kind, KeyboardInterrupt))
        failure: BaseException | None = None
        try:
            if self._last >= 0:
                self._container.mux(self._stream.encode(None))
            self._container.close()
        except (av.error.FFmpegError, OSError) as refused:
            failure = self._refusal(refused)
        if keep and failure is None:
            self._closing.close()
            return
        # The closing stack takes any exception as its sign to remove the temporary file.
        reason = failure or problem or InterruptedError()
        self._closing.__exit__(type(reason), reason, reason.__traceback__)
        if failure is not None and kind is None:
            raise failure

    def _refusal(self, problem: BaseException) -> OutputError:
        return OutputError(f"{self.path}: cannot be written: {getattr(problem, 'strerror', None) or problem}")


def begin_of(path: Path) -> float:
    """When in the footage (s) a written video begins; 0 where it does not say."""
    try:
        with av.open(f"file:{path}") as container:
            comment = container.metadata.get("comment", "")
    except (av.error.FFmpegError, OSError):
        return 0.0
    return float(comment.removeprefix(BEGINS).removesuffix(" s")) if comment.startswith(BEGINS) else 0.0
