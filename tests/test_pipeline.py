"""The shared core: order, bounds, errors and stops across threads; views matched by time."""

import os
import signal
import threading
import time

import numpy as np
import pytest
from clips import write_clip

from visfuse_cli.elsewhere import AHEAD, ahead
from visfuse_cli.files.video import open_source
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Frame


class Stub:
    """A source of empty pictures at given times."""

    frame_count = None

    def __init__(self, camera, times):
        self.camera, self.times = camera, times

    def frames(self):
        for index, t in enumerate(self.times):
            yield Frame(self.camera, index, t, np.zeros((2, 2, 3), np.uint8))


def matched(times, tolerance, **options):
    """Per set: its time, and per view the index of its frame or None."""
    sources = {view: Stub(view, stamps) for view, stamps in times.items()}
    with Run() as run:
        return [
            (s.t, *(s.frames[v].index if v in s.frames else None for v in times))
            for s in run.synchronise(sources, tolerance, **options)
        ]


def threads():
    return {t.name for t in threading.enumerate()} & {"visfuse-decode", "visfuse-write"}


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    assert not threads()


def test_frames_come_in_order_and_wait_is_timed(tmp_path):
    with Run() as run, open_source(write_clip(tmp_path / "a.mp4", [k * 3600 for k in range(30)])) as source:
        assert [f.index for f in run.frames(source)] == list(range(30))
    assert set(run.stages) == {"decode"}


def test_decoding_runs_only_a_little_ahead():
    produced = []

    def numbers():
        for k in range(100):
            produced.append(k)
            yield k

    with ahead(numbers) as items:
        next(items)
        time.sleep(0.1)
        assert len(produced) <= AHEAD + 3


def test_an_error_while_decoding_reaches_the_consumer():
    def broken():
        yield 1
        raise ValueError("at two")

    with ahead(broken) as items:
        assert next(items) == 1
        with pytest.raises(ValueError, match="at two"):
            next(items)


def test_a_consumer_that_fails_leaves_no_thread():
    def consume():
        with Run() as run:
            for frame in run.frames(Stub("image", range(1000))):
                raise RuntimeError(frame.index)

    with pytest.raises(RuntimeError, match="0"):
        consume()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_stream_after_the_current_frame(number):
    before = signal.getsignal(number)
    seen = []
    with Run() as run:
        for frame in run.frames(Stub("image", range(100))):
            seen.append(frame.index)
            if frame.index == 4:
                os.kill(os.getpid(), number)
    assert (seen, run.stopped_by) == ([0, 1, 2, 3, 4], number)
    assert signal.getsignal(number) is before


def test_views_are_matched_by_time():
    assert matched({"a": [0, 1, 2], "b": [0.1, 1.1, 2.1]}, 0.2) == [(0, 0, 0), (1, 1, 1), (2, 2, 2)]
    assert matched({"a": [0, 1, 2], "b": [0.1, 2.1]}, 0.2) == [(0, 0, 0), (1, 1, None), (2, 2, 1)]
    assert matched({"a": [0, 1, 2], "b": [0, 0.4, 0.9, 1.5, 2.1]}, 0.2) == [(0, 0, 0), (1, 1, 2), (2, 2, 4)]
    assert matched({"a": [0, 1], "b": []}, 0.2) == [(0, 0, None), (1, 1, None)]
    assert matched({"a": [], "b": [0]}, 0.2) == []


def test_a_frame_serves_the_nearest_set_only():
    assert matched({"a": [0, 1, 2], "b": [0.9, 1.9]}, 1.0) == [(0, 0, None), (1, 1, 0), (2, 2, 1)]
    assert matched({"a": [0, 1], "b": [0.5]}, 1.0) == [(0, 0, 0), (1, 1, None)]


def test_offsets_bring_views_to_the_leading_clock():
    sources = {"a": Stub("a", [0, 1, 2]), "b": Stub("b", [5, 6, 7])}
    with Run() as run:
        sets = list(run.synchronise(sources, 0.1, {"a": 1.0, "b": -4.0}))
    assert [s.frames["b"].t for s in sets] == [0, 1, 2]
    assert all(not s.missing for s in sets)


def test_synchronise_stops_on_a_signal():
    with Run() as run:
        sets = run.synchronise({"a": Stub("a", range(50)), "b": Stub("b", range(50))}, 0.1)
        next(sets)
        run.stopped_by = signal.SIGTERM
        assert list(sets) == []


class Recorder:
    def __init__(self, fail_at=None):
        self.seen, self.fail_at = [], fail_at

    def write(self, value):
        if value == self.fail_at:
            raise OSError("disk full")
        self.seen.append(value)


def hand_over(sink, n):
    with Run() as run, run.background(sink) as out:
        for k in range(n):
            out.write(k)


def test_background_keeps_order_and_drains():
    sink = Recorder()
    hand_over(sink, 50)
    assert sink.seen == list(range(50))


def test_background_error_reaches_the_caller():
    for last in (3, 200):  # on leaving the block, and while writing
        sink = Recorder(fail_at=3)
        with pytest.raises(OSError, match="disk full"):
            hand_over(sink, last + 1)
        assert sink.seen == [0, 1, 2]


def test_counts_stages_and_warnings_add_up():
    run = Run()
    for _ in range(2):
        run.warn("same")
        run.count("tracks", 2)
        with run.stage("flow"):
            pass
    assert (run.warnings, run.counts["tracks"], list(run.stages)) == (("same",), 4, ["flow"])
