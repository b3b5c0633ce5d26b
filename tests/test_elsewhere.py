"""A generator in a process of its own: order, lag, shared pictures, errors, and what happens when either side dies."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from visfuse_cli.elsewhere import LARGE, Enough, apart
from visfuse_cli.errors import InputError, VisfuseError

LAG = 2


def counting(count, log=None):
    """Yields what it was told so far; returns it with the number of items."""
    told = []
    try:
        for _ in range(count):
            answer = yield list(told)
            told.append(answer)
    except Enough:
        return "enough", told
    return "all", told


def pictures(count):
    for k in range(count):
        yield None if k % 5 == 2 else (k, np.full((300, 400), k, np.uint8), np.full((LARGE, 2), k, float), np.arange(k))


def growing():
    for side in (400, 100, 500):
        yield np.full((side, side), side, np.int32)


def failing(problem):
    yield 1
    raise problem


def waiting():
    while True:
        yield os.getpid()


@pytest.fixture(params=["1", "2"])
def anywhere(request, monkeypatch):
    """Here, and in another process where there is a second core."""
    monkeypatch.setenv("VISFUSE_THREADS", request.param)


@pytest.fixture
def elsewhere(monkeypatch):
    monkeypatch.delenv("VISFUSE_THREADS", raising=False)
    monkeypatch.setattr("visfuse_cli.elsewhere._cores", lambda: 2)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 9])
def test_each_item_is_worked_out_when_the_one_so_many_before_has_been_answered(anywhere, count):
    with apart() as begin:
        exchange = begin(counting, count, lag=LAG)
        for number, told in enumerate(exchange):
            assert told == [None] * min(number, LAG) + list(range(number - LAG))
            exchange.answer(number)
        assert exchange.finish() == ("all", [None] * min(count, LAG) + list(range(count - LAG)))


def test_both_ways_do_the_same(monkeypatch, elsewhere):
    seen = []
    for cap in ("1", "2"):
        monkeypatch.setenv("VISFUSE_THREADS", cap)
        with apart() as begin:
            exchange = begin(counting, 7, lag=LAG)
            items = []
            for number, item in enumerate(exchange):
                items.append(item)
                exchange.answer(10 * number)
            seen.append((items, exchange.finish()))
    assert seen[0] == seen[1]


def test_a_generator_of_which_no_more_is_wanted_returns_what_it_has(anywhere):
    with apart() as begin:
        exchange = begin(counting, 10**9, lag=LAG)
        for number, _ in enumerate(exchange):
            exchange.answer(number)
            if number == 5:
                break
        kind, told = exchange.finish()
        assert kind == "enough"
        assert told[: LAG + 3] == [None] * LAG + [0, 1, 2]
        assert exchange.finish() == (kind, told)


def test_pictures_stay_as_they_are_until_the_next_item_is_answered(elsewhere):
    with apart() as begin:
        exchange = begin(pictures, 30, lag=LAG)
        before, count = None, 0
        for item in exchange:
            time.sleep(0.002)  # for the other side to run ahead
            for k, picture, table, few in filter(None, (before, item)):
                assert (picture == k).all()
                assert (table == k).all()
                assert list(few) == list(range(k))
            exchange.answer(None)
            before, count = item or before, count + 1
        assert count == 30
        assert exchange.finish() is None


def test_what_finds_no_room_goes_along(elsewhere):
    with apart() as begin:
        sizes = [(array.shape, int(array[0, 0])) for array in _answered(begin(growing, lag=1))]
    assert sizes == [((400, 400), 400), ((100, 100), 100), ((500, 500), 500)]


def test_without_room_at_all_the_pictures_go_along(elsewhere):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with apart() as begin:
            sums = [int(array.sum()) for array in _answered(begin(growing, lag=1))]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert sums == [400**3, 100**3, 500**3]


def _answered(exchange):
    for item in exchange:
        yield item
        exchange.answer(None)


def test_a_bad_input_is_raised_here_as_it_was_there(anywhere):
    with apart() as begin, pytest.raises(InputError, match=r"^a\.mp4: ends too soon$"):
        list(_answered(begin(failing, InputError("a.mp4: ends too soon"), lag=LAG)))


def test_a_defect_there_tells_here_where_it_was(elsewhere):
    with apart() as begin, pytest.raises(RuntimeError, match="KeyError: 'nothing'") as caught:
        list(_answered(begin(failing, KeyError("nothing"), lag=LAG)))
    assert "in failing" in caught.value.__notes__[0]


def test_a_process_that_is_killed_is_told_of_in_one_line(elsewhere):
    with apart() as begin:
        exchange = iter(begin(waiting, lag=0))
        os.kill(next(exchange), signal.SIGKILL)
        with pytest.raises(VisfuseError, match=r"was ended, code -9; is memory short\?$"):
            next(exchange)


def test_the_process_is_out_of_reach_of_the_terminal_and_gone_after_the_block(elsewhere):
    with apart() as begin:
        pid = next(iter(begin(waiting, lag=0)))
        assert os.getsid(pid) != os.getsid(0)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


RUN = """
import os, sys
sys.path.insert(0, sys.argv[1])
import visfuse_cli.elsewhere as elsewhere
from test_elsewhere import waiting
elsewhere._cores = lambda: 2
with elsewhere.apart() as begin:
    print(next(iter(begin(waiting, lag=0))), flush=True)
    os.kill(os.getpid(), 9)
"""


def test_the_process_ends_when_the_run_is_killed():
    environment = {name: value for name, value in os.environ.items() if name != "VISFUSE_THREADS"}
    run = subprocess.run(
        [sys.executable, "-c", RUN, str(Path(__file__).parent)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    pid = int(run.stdout)
    for _ in range(100):
        if not _lives(pid):
            break
        time.sleep(0.1)
    outlived = _lives(pid)
    if outlived:
        os.kill(pid, signal.SIGKILL)
    assert not outlived


def _lives(pid):
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().split()[2] != "Z"
