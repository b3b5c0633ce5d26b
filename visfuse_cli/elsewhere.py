"""Work that goes on elsewhere while something else is thought about: a thread that decodes, a process that looks.

Threads share one interpreter lock: whoever computes in small steps waits for it again and again. What calls into OpenCV
many times a frame has a process of its own, therefore; a thread is for what is done in a few calls.
"""

from __future__ import annotations

import itertools
import mmap
import os
import pickle
import queue
import socket
import subprocess
import sys
import tempfile
import threading
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any, Protocol, TypeVar

from visfuse_cli.errors import VisfuseError
from visfuse_cli.threads import thread_cap

T = TypeVar("T")
Item_co = TypeVar("Item_co", covariant=True)
Answer_contra = TypeVar("Answer_contra", contravariant=True)
Result_co = TypeVar("Result_co", covariant=True)

AHEAD = 3  # pictures that wait between two threads: enough to even out, too few to fill memory
ENDED: Any = object()
LARGE = 1 << 16  # bytes of an array that is shared and not sent
ALIGNED = 64  # bytes
NOBODY = (EOFError, BrokenPipeError, ConnectionResetError)  # at the other end any more
LIFE = "from visfuse_cli.elsewhere import serve; serve({}, {})"


@contextmanager
def ahead(produce: Callable[[], Iterator[T]], limit: int = AHEAD) -> Iterator[Iterator[T]]:
    """Run a generator in a thread of its own, at most `limit` items ahead; its exception is raised in the consumer.

    The whole generator lives in that thread, decoders included; leaving the block ends and joins it. Where a run may
    use no other thread, it is run in the consumer's.
    """
    if thread_cap() == 1:
        yield produce()
        return
    items: queue.Queue[tuple[T, BaseException | None]] = queue.Queue(limit)
    stopped = threading.Event()

    def work() -> None:
        problem: BaseException | None = None
        try:
            for item in produce():
                items.put((item, None))
                if stopped.is_set():
                    return
        except BaseException as raised:
            problem = raised
        items.put((ENDED, problem))

    def consume() -> Iterator[T]:
        while True:
            item, problem = items.get()
            if problem is not None:
                raise problem
            if item is ENDED:
                return
            yield item

    thread = threading.Thread(target=work, name="visfuse-decode", daemon=True)
    thread.start()
    try:
        yield consume()
    finally:
        stopped.set()
        while thread.is_alive():  # a full queue holds the thread: empty it
            try:
                items.get(timeout=0.05)
            except queue.Empty:
                thread.join(0.01)
        thread.join()


class Enough(Exception):
    """Raised in a generator of which no more is wanted: it returns its result."""


class Exchange(Protocol[Item_co, Answer_contra, Result_co]):
    """What a generator yields, item by item: `answer` each, and `finish` for what the generator returns.

    A generator that is to run `lag` items ahead is told the answer to the item of so many before when it goes on from
    one, and None while there is no such item. The arrays of an item may be read until the next one is answered.
    """

    def __iter__(self) -> Iterator[Item_co]: ...

    def answer(self, answer: Answer_contra) -> None:
        """Answer the item given last."""

    def finish(self) -> Result_co:
        """What the generator returns, at its end or before."""


class Begin(Protocol):
    """Sets a generator going, once."""

    def __call__(
        self, make: Callable[..., Generator[Item_co, Answer_contra | None, Result_co]], *args: Any, lag: int
    ) -> Exchange[Item_co, Answer_contra, Result_co]: ...


@contextmanager
def apart() -> Iterator[Begin]:
    """A process for a generator: it gets ready while something else is done, and ends with the block.

    Where a run may use no other thread the generator runs here: what is done, and in which order, is the same.
    """
    if thread_cap() == 1 or _cores() == 1:
        yield _Here
        return
    other = _Other()
    try:
        yield other.begin
    finally:
        other.end()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Here:
    """A generator that runs here."""

    def __init__(self, make: Callable[..., Generator[Any, Any, Any]], *args: Any, lag: int) -> None:
        self._generator, self._lag = make(*args), lag
        self._ready: deque[Any] = deque()
        self._answers: deque[Any] = deque([None] * (lag + 1))
        self._result: Any = ENDED

    def __iter__(self) -> Iterator[Any]:
        while True:
            while len(self._ready) <= self._lag and self._result is ENDED:
                try:
                    self._ready.append(self._generator.send(self._answers.popleft()))
                except StopIteration as end:
                    self._result = end.value
            if not self._ready:
                return
            yield self._ready.popleft()

    def answer(self, answer: Any) -> None:
        self._answers.append(answer)

    def finish(self) -> Any:
        if self._result is ENDED:
            try:
                self._generator.throw(Enough())
            except StopIteration as end:
                self._result = end.value
        return self._result


class _Other:
    """A process, and the generator that runs in it, as seen from here."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        self._memory = _memory_file()
        self._shared: mmap.mmap | None = None
        self._result: Any = ENDED
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", LIFE.format(theirs.fileno(), self._memory)],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
                pass_fds=(theirs.fileno(), self._memory),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,  # what the terminal interrupts is the run, which ends the process
            )
        self._line = Connection(ours.detach())

    def begin(self, make: Callable[..., Generator[Any, Any, Any]], *args: Any, lag: int) -> _Other:
        self._send((make, args, lag))
        return self

    def __iter__(self) -> Iterator[Any]:
        while self._result is ENDED:
            kind, item = self._next()
            if kind == "item":
                yield item

    def answer(self, answer: Any) -> None:
        if self._result is ENDED:
            self._send((True, answer))

    def finish(self) -> Any:
        if self._result is ENDED:
            self._send((False, None))
        while self._result is ENDED:
            self._next()
        return self._result

    def end(self) -> None:
        """End the process: nothing of it is wanted any more."""
        self._process.kill()
        self._process.wait()
        self._line.close()
        os.close(self._memory)

    def _send(self, message: Any) -> None:
        with suppress(*NOBODY):  # who asks for the next item is told
            self._line.send_bytes(pickle.dumps(message, protocol=5))

    def _next(self) -> tuple[str, Any]:
        try:
            kind, data, extents = pickle.loads(self._line.recv_bytes())
        except NOBODY:
            code = self._process.wait()
            raise VisfuseError(f"the process that reads the footage was ended, code {code}; is memory short?") from None
        item = pickle.loads(data, buffers=[self._view(*extent) for extent in extents])
        if kind == "problem":
            raise item
        if kind == "result":
            self._result = item
        return kind, item

    def _view(self, first: int, last: int) -> memoryview:
        if self._shared is None:  # it has its size from the first item on
            self._shared = mmap.mmap(self._memory, os.fstat(self._memory).st_size)
        return memoryview(self._shared)[first:last]


def _memory_file() -> int:
    """A file to share, in memory where the system has such."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("visfuse")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def serve(line: int, memory: int) -> None:
    """The life of the other process: run a generator for whoever is at the other end of the line."""
    warnings.simplefilter("ignore")  # as in the run itself
    with Connection(line) as connection, suppress(*NOBODY):
        _run(connection, memory)


def _run(connection: Connection, memory: int) -> None:
    make, args, lag = pickle.loads(connection.recv_bytes())
    slots = _Slots(memory, lag + 2)  # for those ahead, the present item, and the one before it
    generator = make(*args)
    kind, item = _stepped(generator.send, None)
    for number in itertools.count():
        connection.send_bytes(pickle.dumps((kind, *slots.put(item)), protocol=5))
        if kind != "item":
            break
        wanted, answer = (True, None) if number < lag else pickle.loads(connection.recv_bytes())
        kind, item = _stepped(generator.send, answer) if wanted else _stepped(generator.throw, Enough())
    while True:  # what is still answered is read, until nobody is there
        connection.recv_bytes()


def _stepped(step: Callable[[Any], Any], told: Any) -> tuple[str, Any]:
    """What comes of one step of a generator: an item, its result, or what went wrong."""
    try:
        return "item", step(told)
    except StopIteration as end:
        return "result", end.value
    except VisfuseError as problem:
        return "problem", problem
    except Exception as problem:
        defect = RuntimeError(f"{type(problem).__name__}: {problem}")
        defect.add_note("".join(traceback.format_exception(problem)))
        return "problem", defect


class _Slots:
    """Shared memory in which the large arrays of several items find room, one after another; all items are alike."""

    def __init__(self, memory: int, count: int) -> None:
        self._memory, self._count = memory, count
        self._size = self._used = 0
        self._shared: mmap.mmap | None = None

    def put(self, item: Any) -> tuple[bytes, list[tuple[int, int]]]:
        """An item without its large arrays, and where (first byte, last) these lie; with them where they find no room,
        which is made for those of the first item."""
        large: list[memoryview] = []

        def small(buffer: pickle.PickleBuffer) -> bool:
            raw = buffer.raw()
            if raw.nbytes >= LARGE:
                large.append(raw)
            return raw.nbytes < LARGE

        data = pickle.dumps(item, protocol=5, buffer_callback=small)
        ends = list(itertools.accumulate((-(-raw.nbytes // ALIGNED) * ALIGNED for raw in large), initial=0))
        if not large:
            return data, []
        if not self._size:
            self._size = ends[-1]
            with suppress(OSError):  # no room, or none allowed
                os.ftruncate(self._memory, self._size * self._count)
                self._shared = mmap.mmap(self._memory, self._size * self._count)
        if self._shared is None or ends[-1] > self._size:
            return pickle.dumps(item, protocol=5), []
        first, self._used = self._used % self._count * self._size, self._used + 1
        extents = [(first + end, first + end + raw.nbytes) for end, raw in zip(ends[:-1], large, strict=True)]
        for (begin, end), raw in zip(extents, large, strict=True):
            self._shared[begin:end] = raw
        return data, extents
