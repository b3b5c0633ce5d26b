"""The folder of one run: created, locked against a second run, cleared of an earlier run's results."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

from visfuse_cli.errors import BusyError, OutputError
from visfuse_cli.files.atomic import PARTIAL_PREFIX, PARTIAL_SUFFIX, failing_as_output

LOCK = ".visfuse.lock"
TRACKS_PARTIAL = ".tracks.partial.jsonl"
RESULTS = (
    *("tracks.json", "speeds.csv", "rejected.csv", "run.json", "report.html", "evaluation.json"),
    *("calibration.png", "lanes.yaml", "map.png", "mosaic.mp4", "annotated*.mp4"),
)
LEFTOVERS = (TRACKS_PARTIAL, f"{PARTIAL_PREFIX}*{PARTIAL_SUFFIX}")  # of a run that was killed


class RunFolder:
    """`with RunFolder(out, overwrite) as folder:` holds an output folder for one run and yields its path.

    Enter it once every input is validated: with `overwrite` the earlier run's results go on entering, and nothing
    else does. A folder that holds only what a killed run left behind counts as empty. Raises OutputError where the
    folder is not empty or cannot be made, or where one of `inputs` is it or would be lost in it, BusyError where
    another run holds it. A `shared` folder is one above several runs: it is locked, and nothing in it is touched.
    """

    def __init__(
        self, out: str | Path, overwrite: bool = False, *, inputs: Iterable[str | Path] = (), shared: bool = False
    ) -> None:
        self.path = Path(out)
        self.inputs = {Path(path).resolve() for path in inputs}
        self.overwrite = overwrite
        self.shared = shared
        self._lock = -1
        self._created = False

    def __enter__(self) -> Path:
        with failing_as_output(self.path):
            if self.path.exists() and not self.path.is_dir():
                raise OutputError(f"{self.path}: is a file; give --out a folder")
            self._created = not self.path.exists()
            self.path.mkdir(parents=True, exist_ok=True)
            self._acquire()
            try:
                if not self.shared:
                    self._clear()
            except BaseException:
                self._release()
                raise
        return self.path

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._release()
        if kind is not None and self._created and not any(self.path.iterdir()):
            self.path.rmdir()  # a run that failed before its first result leaves nothing behind

    def _acquire(self) -> None:
        """Take the lock; the lock file may vanish under our feet as its last holder ends, hence the loop."""
        name = self.path / LOCK
        while self._lock < 0:
            lock = os.open(name, os.O_CREAT | os.O_RDWR, 0o666)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if name.exists() and os.path.samestat(os.fstat(lock), name.stat()):
                    self._lock = lock
            except BlockingIOError as problem:
                raise BusyError(f"{self.path}: another run holds this folder; wait, or choose another") from problem
            finally:
                if self._lock != lock:
                    os.close(lock)

    def _release(self) -> None:
        (self.path / LOCK).unlink(missing_ok=True)  # still locked: nobody else can hold it now
        os.close(self._lock)
        self._lock = -1

    def _clear(self) -> None:
        leftovers = {name for pattern in LEFTOVERS for name in self.path.glob(pattern)}
        present = set(self.path.iterdir()) - leftovers - {self.path / LOCK}
        if present and not self.overwrite:
            raise OutputError(f"{self.path}: is not empty; give --overwrite or another folder")
        results = {name for pattern in RESULTS for name in self.path.glob(pattern)}
        lost = sorted({name.resolve() for name in (self.path, *results)} & self.inputs)
        if lost:
            raise OutputError(f"{lost[0]}: is an input, and results would take its place; give --out another folder")
        for name in leftovers | results:
            name.unlink()
