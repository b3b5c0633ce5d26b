"""What a worker does with an item: the run, a log of it, and a record that it is finished."""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from visfuse_cli import report
from visfuse_cli.apps import traffic_log
from visfuse_cli.apps.batch.manifest import Item
from visfuse_cli.errors import InputError, VisfuseError
from visfuse_cli.files.atomic import failing_as_output, write_json
from visfuse_cli.records import RunResult
from visfuse_cli.threads import capped

RECORD, LOG = "batch.json", "batch.log"
MODULES = {
    "calibrate-homography": "visfuse_cli.commands.calibrate_homography",
    "speed": "visfuse_cli.commands.speed",
    "track-imm": "visfuse_cli.commands.track_imm",
    "track-stereo-pf": "visfuse_cli.commands.track_stereo_pf",
    "fuse-cameras": "visfuse_cli.commands.fuse_cameras",
}
WORTH_ANOTHER_TRY = (1, 4, 75)  # a bad input stays bad
_one_at_a_time = threading.Lock()  # a worker of somebody's cluster may have several threads


@dataclass(frozen=True, slots=True)
class Outcome:
    """How an item ended: the exit code that the command itself would have had, s, warnings, and what is wrong."""

    name: str
    status: str  # done, kept, failed, lost, left
    code: int | None
    seconds: float = 0.0
    warnings: int = 0
    message: str = ""


class ItemFailed(Exception):
    """An item that is worth another try; carries its outcome."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome)
        self.outcome = outcome


def folder_of(item: Item) -> Path:
    """Where an item's results go."""
    out = item.request.out
    return out.parent if item.request.command == "calibrate-homography" else out


def kept(item: Item) -> Outcome | None:
    """The outcome of an earlier batch that has finished this very item: same settings, inputs unchanged."""
    try:
        record = json.loads((folder_of(item) / RECORD).read_text(encoding="utf-8"))
        if record["key"] == _key(item):
            return Outcome(item.name, "kept", 0, float(record["seconds"]), int(record["warnings"]))
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return None


def forget(item: Item) -> None:
    """Take away the record and the log of an earlier batch."""
    folder = folder_of(item)
    with failing_as_output(folder):
        for name in (RECORD, LOG):
            (folder / name).unlink(missing_ok=True)


def perform(item: Item, threads: int) -> Outcome:
    """Run an item; raises ItemFailed where it failed for a reason that may pass."""
    with _one_at_a_time, capped(threads):
        begun = time.monotonic()
        warnings: tuple[str, ...] = ()
        try:
            folder = folder_of(item)
            with failing_as_output(folder):
                folder.mkdir(parents=True, exist_ok=True)
                (folder / RECORD).unlink(missing_ok=True)
            _note(item, f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} process {os.getpid()}: {item.request.command}")
            key = _key(item)  # of the inputs as they are before the run
            result = _run(item)
            warnings = result.warnings
            outcome = Outcome(item.name, "done", 0, round(time.monotonic() - begun, 3), len(warnings))
            for line in _lines(result):
                _note(item, line)
            write_json(folder / RECORD, {"schema": "visfuse.batch-item/1", "key": key, **asdict(outcome)})
        except Exception as problem:
            outcome = _failure(item, problem, round(time.monotonic() - begun, 3), len(warnings))
    if outcome.code in WORTH_ANOTHER_TRY and item.retries:
        raise ItemFailed(outcome)
    return outcome


def _run(item: Item) -> RunResult:
    request, command = item.request, import_module(MODULES[item.request.command])
    if item.log is not None:
        return traffic_log.run(request, item.log)
    result: RunResult = command.run(request)
    if request.report and request.command != "calibrate-homography":
        report.write([request.out])
    return result


def _lines(result: RunResult) -> Iterator[str]:
    for warning in result.warnings:
        yield f"warning: {warning}"
    for stage, seconds in result.stages.items():
        yield f"{stage}: {seconds:.2f} s"
    yield json.dumps(result.summary, allow_nan=False)


def _failure(item: Item, problem: Exception, seconds: float, warnings: int) -> Outcome:
    expected = isinstance(problem, VisfuseError)
    code = problem.exit_code if isinstance(problem, VisfuseError) else 1
    message = " ".join(str(problem).split()) if expected else f"{type(problem).__name__}: {problem}"
    with suppress(VisfuseError):  # where the log cannot be written either, the table says what is wrong
        _note(item, f"failed: {message}" if expected else "".join(traceback.format_exception(problem)))
    return Outcome(item.name, "failed", code, seconds, warnings, message)


def _note(item: Item, line: str) -> None:
    path = folder_of(item) / LOG
    with failing_as_output(path), open(path, "a", encoding="utf-8", errors="backslashreplace") as log:
        log.write(line + "\n")


def _key(item: Item) -> str:
    """The hash of all that an item's results depend on: settings, and size and time of its input files."""
    request = item.request
    paths = [request.input, *(value for value in request.options.values() if isinstance(value, Path))]
    asked: dict[str, Any] = {
        "command": request.command,
        "config": request.config.model_dump(mode="json"),
        "options": {name: str(value) for name, value in request.options.items()},
        "log": str(item.log),
        **{name: getattr(request, name) for name in ("video", "report", "start", "end", "seed")},
        "files": [state for path in paths for state in _states(path)],
    }
    return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()


def _states(path: Path) -> Iterator[tuple[str, int, int]]:
    """Name, size and time (ns) of a file, or of each in a folder and in its folders: an image folder a camera."""
    names = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
    try:
        for name in names:
            found = name.stat()
            yield str(name), found.st_size, found.st_mtime_ns
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror}") from problem
