"""Where the command line begins, and the one place that catches errors."""

from __future__ import annotations

import os
import sys
import tempfile
import traceback
from pathlib import Path
from typing import NoReturn

import typer

from visfuse_cli import __version__
from visfuse_cli.cli import batch, calibrate, configure, read, track  # noqa: F401  (each adds its commands to the app)
from visfuse_cli.cli.app import app
from visfuse_cli.errors import VisfuseError


def _fail(message: str, code: int) -> NoReturn:
    # A path may hold bytes that no terminal can show.
    line = " ".join(str(message).split()).encode("utf-8", "backslashreplace").decode()
    print(f"visfuse: {line}", file=sys.stderr)
    sys.exit(code)


def main() -> None:
    """Run the command line; every expected failure ends as one line on stderr and its exit code."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # small matrices only; one thread keeps sums in one order
    try:
        code = app(standalone_mode=False)
    except VisfuseError as problem:
        _fail(str(problem), problem.exit_code)
    except typer.Exit as leaving:
        sys.exit(leaving.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted", 130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except Exception as problem:
        usage = getattr(problem, "format_message", None)  # click's own errors: the command line is wrong
        if usage is not None:
            _fail(usage(), getattr(problem, "exit_code", 2))
        _fail(f"internal error: {type(problem).__name__}: {problem}; traceback in {_log(problem)}", 1)
    sys.exit(code if isinstance(code, int) else 0)


def _log(problem: BaseException) -> Path:
    """Keep the traceback of a defect in a file of its own."""
    handle, name = tempfile.mkstemp(prefix="visfuse-", suffix=".log")
    with os.fdopen(handle, "w", encoding="utf-8") as log:
        log.write(f"visfuse {__version__}: {' '.join(sys.argv)}\n")
        traceback.print_exception(problem, file=log)
    return Path(name)
