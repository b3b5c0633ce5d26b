"""The shared core of every command: frames by time, stop requests, work that overlaps, stage times, warnings."""

from __future__ import annotations

import gc
import itertools
import queue
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Protocol, TypeVar

import cv2
from tqdm import tqdm

from visfuse_cli.elsewhere import AHEAD, ENDED, ahead
from visfuse_cli.files.folders import paths_of
from visfuse_cli.files.run_json import write_run_json
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video import VideoSource
from visfuse_cli.records import Frame, FrameSet, RunRequest, TimeAudit
from visfuse_cli.threads import thread_cap

T = TypeVar("T")
GAP = 2.5  # intervals without a frame of the leading view that are bridged
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Sink(Protocol):
    """Anything that takes one thing after another, like a VideoWriter."""

    def write(self, *values: Any) -> None: ...


class Run:
    """`with Run(progress=True) as run:` is one run of a command.

    The first SIGINT or SIGTERM ends the stream of frames after the current one and is kept in `stopped_by`, so that
    the command finishes its files; a second one kills. Results do not depend on the threads used here: they keep order.
    """

    def __init__(self, progress: bool = False) -> None:
        self.progress = progress and sys.stderr.isatty()
        self.stopped_by: int | None = None
        self.started = datetime.now(UTC)
        self.stages: dict[str, float] = {}  # seconds by name
        self.counts: Counter[str] = Counter()
        self._warnings: dict[str, None] = {}  # an ordered set
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Run:
        cv2.setNumThreads(thread_cap() or -1)  # -1: OpenCV's own choice
        if threading.current_thread() is threading.main_thread():
            self._handlers = {number: signal.signal(number, self._stop) for number in STOP_SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.stopped_by = number
        for each in STOP_SIGNALS:
            signal.signal(each, signal.SIG_DFL)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was warned of, each text once."""
        return tuple(self._warnings)

    def warn(self, text: str) -> None:
        """Keep a warning for run.json and the terminal."""
        self._warnings[text] = None

    def count(self, name: str, n: int = 1) -> None:
        """Add to a count of run.json."""
        self.counts[name] += n

    def audited(self, sources: Mapping[str, VideoSource]) -> dict[str, TimeAudit]:
        """The time audits of sources that were read, by name; what is doubtful about them is warned of."""
        audits = {name: source.audit() for name, source in sources.items()}
        for audit in audits.values():
            for warning in audit.warnings:
                self.warn(warning)
        return audits

    def write_json(
        self,
        folder: Path,
        request: RunRequest,
        inputs: Sequence[Mapping[str, Any]],
        audits: Mapping[str, TimeAudit],
        extra: Mapping[str, Any],
    ) -> None:
        """Write run.json: what was asked, what was read, and what this run counted, timed and warned of."""
        write_run_json(
            folder / "run.json",
            command=request.command,
            argv=request.argv,
            config=request.config.model_dump(mode="json"),
            inputs=inputs,
            seed=request.seed,
            started=self.started,
            audits=audits,
            warnings=self.warnings,
            counts=self.counts,
            stages=self.stages,
            stopped_by=self.stopped_by,
            extra=extra,
        )

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the wall time of the block to a stage of run.json."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.stages[name] = self.stages.get(name, 0.0) + time.perf_counter() - begun

    def frames(self, source: VideoSource, total: int | None = None) -> Iterator[Frame]:
        """The frames of one clip, decoded ahead in a thread, until they end or the run is stopped."""
        with ahead(source.frames) as frames:
            yield from self.until_stopped(frames, source.frame_count if total is None else total)

    def until_stopped(self, items: Iterable[T], total: int | None) -> Iterator[T]:
        """The same items, as many as `total` where that is known, with a progress bar, until the run is stopped."""
        with self._bar(total) as bar:
            for item in self._waited(iter(items)):
                yield item
                bar.update()
                if self.stopped_by is not None:
                    return

    def synchronise(
        self,
        sources: Mapping[str, VideoSource],
        tolerance_s: float,
        offsets: Mapping[str, float] | None = None,
        interval_s: float | None = None,
    ) -> Iterator[FrameSet]:
        """Sets of frames by time: the first view leads, each other one adds its nearest frame within `tolerance_s`.

        `offsets` (s by view) are added to a view's own times to reach the shared clock; all times come out on the
        leading view's. A frame belongs to one set at most: to that whose time is nearest to its own. With `interval_s`
        sets go on, so far apart, where the leading view has a gap or has ended, until the last view ends.
        """
        leader, *others = sources
        shift = {view: (offsets or {}).get(view, 0.0) - (offsets or {}).get(leader, 0.0) for view in sources}
        with ExitStack() as stack:
            streams = {view: stack.enter_context(ahead(source.frames)) for view, source in sources.items()}
            cursors = {view: _Cursor(self._waited(streams[view]), shift[view]) for view in others}
            bar = stack.enter_context(self._bar(sources[leader].frame_count))
            for index, t, following, frame in _instants(self._waited(streams[leader]), cursors, interval_s):
                found = {} if frame is None else {leader: frame}
                for view, cursor in cursors.items():
                    match = cursor.nearest(t, tolerance_s, following)
                    if match is not None:
                        found[view] = match
                if self.stopped_by is not None:
                    return
                yield FrameSet(t, found, tuple(view for view in sources if view not in found), index)
                bar.update()

    @contextmanager
    def background(self, sink: Sink) -> Iterator[Sink]:
        """Let `sink.write` run in a thread, in order, a few pictures behind; its error is raised here.

        What is handed over must not be changed afterwards. Closing the sink stays with its owner, after this block.
        """
        if thread_cap() == 1:
            yield _TimedWriter(sink, self)
            return
        writer = _BackgroundWriter(sink)
        try:
            yield writer
        except BaseException:
            writer.finish(discard=True)
            raise
        with self.stage("write"):
            writer.finish(discard=False)

    def _waited(self, items: Iterator[T]) -> Iterator[T]:
        """The same items; waiting for them is the stage `decode`."""
        while True:
            with self.stage("decode"):
                item = next(items, ENDED)
            if item is ENDED:
                return
            yield item

    def _bar(self, total: int | None) -> Any:
        return tqdm(total=total, unit=" frames", file=sys.stderr, disable=not self.progress, leave=False)


@contextmanager
def opened(
    request: RunRequest, inputs: Iterable[dict[str, Any]], frame_of_reference: str
) -> Iterator[tuple[Path, Run, TrackSpool]]:
    """One run and what it writes to: its folder, held and cleared, and tracks.json. `inputs` are as described."""
    if not gc.get_freeze_count():
        gc.freeze()  # what was imported stays: to look through it for garbage took longer than all else
    with (
        RunFolder(request.out, request.overwrite, inputs=[request.input, *paths_of(inputs)]) as folder,
        Run(request.progress) as run,
        TrackSpool(folder, request.command, request.seed, frame_of_reference) as spool,
    ):
        yield folder, run, spool


def _instants(
    leading: Iterator[Frame], cursors: Mapping[str, _Cursor], interval_s: float | None
) -> Iterator[tuple[int, float, float | None, Frame | None]]:
    """The instants of sets: index, time, time of the following one if there is one, and the leading view's frame."""
    frame = next(leading, None)
    while frame is not None:
        following = next(leading, None)
        due = None if following is None else following.t
        empty = _between(frame.t, due, interval_s)
        upcoming = next(empty, due)
        yield frame.index, frame.t, upcoming, frame
        number = frame.index
        while upcoming is not None and upcoming != due and any(not cursor.ended for cursor in cursors.values()):
            t, upcoming, number = upcoming, next(empty, due), number + 1
            yield number if due is None else -1, t, upcoming, None
        frame = following


def _between(t: float, due: float | None, interval_s: float | None) -> Iterator[float]:
    """Times every `interval_s` after t and well before `due`, or without end."""
    if interval_s is None or (due is not None and due - t < GAP * interval_s):
        return
    for number in itertools.count(1):
        if due is not None and t + (number + 0.5) * interval_s > due:
            return
        yield t + number * interval_s


class _Cursor:
    """Walks one view's frames, on the leading view's clock, along rising times; holds two of them."""

    def __init__(self, frames: Iterator[Frame], shift: float) -> None:
        self._frames = (replace(frame, t=frame.t + shift) for frame in frames)
        self._before: Frame | None = None
        self._after = next(self._frames, None)

    @property
    def ended(self) -> bool:
        """Whether no frame is left."""
        return self._before is None and self._after is None

    def nearest(self, t: float, tolerance_s: float, following: float | None) -> Frame | None:
        """The frame nearest to `t`, unless it is too far off or nearer to the leading view's following frame."""
        while self._after is not None and self._after.t <= t:
            self._before, self._after = self._after, next(self._frames, None)
        if self._before is not None and t - self._before.t > tolerance_s:
            self._before = None
        candidates = [frame for frame in (self._before, self._after) if frame is not None]
        best = min(candidates, key=lambda frame: abs(frame.t - t), default=None)
        if best is None or abs(best.t - t) > tolerance_s:
            return None
        if following is not None and abs(best.t - following) < abs(best.t - t):
            return None
        if best is self._before:
            self._before = None
        else:
            self._after = next(self._frames, None)
        return best


class _TimedWriter:
    """Writes in the thread of its caller, where a run may use no other."""

    def __init__(self, sink: Sink, run: Run) -> None:
        self._sink, self._run = sink, run

    def write(self, *values: Any) -> None:
        with self._run.stage("write"):
            self._sink.write(*values)


class _BackgroundWriter:
    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._queue: queue.Queue[tuple[Any, ...] | None] = queue.Queue(AHEAD)
        self._problem: BaseException | None = None
        self._discard = False
        self._thread = threading.Thread(target=self._work, name="visfuse-write", daemon=True)
        self._thread.start()

    def write(self, *values: Any) -> None:
        if self._problem is not None:
            raise self._problem
        self._queue.put(values)

    def finish(self, discard: bool) -> None:
        self._discard = discard
        self._queue.put(None)
        self._thread.join()
        if self._problem is not None and not discard:
            raise self._problem

    def _work(self) -> None:
        while (values := self._queue.get()) is not None:
            if self._problem is None and not self._discard:
                try:
                    self._sink.write(*values)
                except BaseException as problem:
                    self._problem = problem  # raised by the next `write`, or by `finish`
