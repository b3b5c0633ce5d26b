"""What a run may take of a machine that it shares: threads (the variable VISFUSE_THREADS) and memory."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

from visfuse_cli.errors import UsageError

VARIABLE = "VISFUSE_THREADS"


def thread_cap() -> int | None:
    """The most threads that OpenCV, FFmpeg and the stages of a run may use each; None: as many as there are cores.

    With 1, decoding and writing run in the thread of the run itself. Raises UsageError where the variable is no count.
    """
    text = os.environ.get(VARIABLE)
    if not text:
        return None
    if not (text.isdecimal() and 0 < int(text) <= 1024):
        raise UsageError(f"{VARIABLE}={text}: a number of threads, 1 to 1024")
    return int(text)


def give_back() -> None:
    """Hand freed memory back to the system: glibc keeps what pictures took, for each thread that ever held some."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


@contextmanager
def capped(threads: int) -> Iterator[None]:
    """Cap the block's runs, and the linear algebra they call, to so many threads each."""
    from threadpoolctl import threadpool_limits  # of the extra `batch`, whose workers alone come here

    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = str(threads)
    try:
        with threadpool_limits(threads):
            yield
    finally:
        if before is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = before
