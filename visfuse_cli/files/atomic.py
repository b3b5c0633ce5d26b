"""Files that appear whole or not at all: a temporary name in the same folder, fsync, rename."""

from __future__ import annotations

import json
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from visfuse_cli.errors import OutputError

PARTIAL_PREFIX, PARTIAL_SUFFIX = ".visfuse-", ".partial"  # a killed run's leftovers are known by these


@contextmanager
def failing_as_output(path: Path) -> Iterator[None]:
    """Turn the operating system's refusal to write `path` into an OutputError that names it."""
    try:
        yield
    except OSError as problem:
        raise OutputError(f"{path}: cannot be written: {problem.strerror or problem}") from problem


@contextmanager
def replacing_path(path: str | Path) -> Iterator[Path]:
    """Yield the name of a new empty file that becomes `path` when the block ends well, and vanishes otherwise.

    Raises OutputError where `path` is a folder or a device, or the system refuses to write.
    """
    target = Path(os.path.realpath(path))  # a link keeps pointing where it did
    with failing_as_output(Path(path)):
        if target.exists() and not stat.S_ISREG(target.stat().st_mode):
            raise OutputError(f"{path}: is a {'folder' if target.is_dir() else 'device'}; give the name of a file")
        partial = target.with_name(f"{PARTIAL_PREFIX}{secrets.token_hex(6)}{PARTIAL_SUFFIX}")
        os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        yield partial
        with failing_as_output(Path(path)):
            descriptor = os.open(partial, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
            os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def replacing(path: str | Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open `path` for writing ("wb" or "w", UTF-8) so that it appears whole or not at all; raises OutputError.

    Bytes of a file's name that are no UTF-8 are written as escapes.
    """
    encoding, newline, errors = (None, None, None) if "b" in mode else ("utf-8", "", "backslashreplace")
    with (
        replacing_path(path) as partial,
        failing_as_output(Path(path)),
        open(partial, mode, encoding=encoding, newline=newline, errors=errors) as file,
    ):
        yield file


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8; raises OutputError."""
    with replacing(path, "w") as file:
        file.write(text)


def write_json(path: str | Path, value: Any) -> None:
    """Write one JSON value, indented; raises ValueError on NaN and infinity, OutputError where it cannot be written."""
    with replacing(path, "w") as file:
        json.dump(value, file, indent=2, allow_nan=False, ensure_ascii=False)
        file.write("\n")
