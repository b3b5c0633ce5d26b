"""Where the command line begins, and the one place that catches errors."""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
import tempfile
import traceback
import warnings
from importlib import import_module
from types import FrameType
from typing import NoReturn

import typer

from visfuse_cli import __version__
from visfuse_cli.cli.app import app
from visfuse_cli.errors import OutputError, VisfuseError

for group in ("calibrate", "track", "read", "batch", "configure"):  # in the order of --help
    import_module(f"visfuse_cli.cli.{group}")  # adds its commands to the app


def _fail(message: str, code: int) -> NoReturn:
    print(f"visfuse: {' '.join(str(message).split())}", file=sys.stderr)
    sys.exit(code)


class _Terminated(BaseException):
    """SIGTERM before or after the part of a run that handles it."""


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a second one kills
    raise _Terminated


def _discard_output() -> None:
    """What still waits to be printed goes nowhere, so that leaving does not fail on it again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def main() -> None:
    """Run the command line; every expected failure ends as one line on stderr and its exit code."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # small matrices only; one thread keeps sums in one order
    sys.stdout, sys.stderr = (stream or open(os.devnull, "w") for stream in (sys.stdout, sys.stderr))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a path may hold bytes that no terminal can show
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # of libraries, about numbers that the results are checked for
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _terminate)
    try:
        code = app(standalone_mode=False)
        sys.stdout.flush()
    except VisfuseError as problem:
        _fail(str(problem), problem.exit_code)
    except typer.Exit as leaving:
        sys.exit(leaving.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted", 130)
    except _Terminated:
        _fail("terminated", 143)
    except BrokenPipeError:
        _discard_output()
        sys.exit(141)
    except Exception as problem:
        if isinstance(problem, OSError) and problem.errno == errno.ENOSPC:  # results go to a full device
            _discard_output()
            _fail(f"the output cannot be written: {problem.strerror}", OutputError.exit_code)
        usage = getattr(problem, "format_message", None)  # click's own errors: the command line is wrong
        if usage is not None:
            _fail(usage(), _usage_code(problem, usage()))
        _fail(f"internal error: {type(problem).__name__}: {problem}; traceback in {_log(problem)}", 1)
    sys.exit(code if isinstance(code, int) else 0)


def _usage_code(problem: Exception, message: str) -> int:
    """A path that must not be read is no wrong command line: it is an input, or where results go."""
    if message.endswith("is not readable."):
        return 4 if getattr(getattr(problem, "param", None), "name", "") == "out" else 3
    return int(getattr(problem, "exit_code", 2))


def _log(problem: BaseException) -> str:
    """Keep the traceback of a defect in a file of its own; returns its name, or why there is none."""
    try:
        handle, name = tempfile.mkstemp(prefix="visfuse-", suffix=".log")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as log:
            log.write(f"visfuse {__version__}: {' '.join(sys.argv)}\n")
            traceback.print_exception(problem, file=log)
    except OSError as refused:
        return f"no file: {refused.strerror or refused}"
    return name
