"""The traffic log: vehicles of many recordings in one SQLite file, each recording added once and as a whole."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from visfuse_cli.errors import BusyError, InputError, OutputError
from visfuse_cli.files.folders import describe

APPLICATION = 0x56465331  # "VFS1"
WAIT_S = 60.0  # for another writer
FIELDS = tuple(
    "track_id t_start t_end time_utc direction lane speed_kmh ci95_low_kmh ci95_high_kmh distance_m n_frames".split()
)
NUMBERS = frozenset(FIELDS) - {"time_utc"} | {"duration_s", "frames"}
LARGEST = 1e9  # of any unit: what is beyond it was not measured
MIGRATIONS = (  # from version i to i + 1
    """
    CREATE TABLE clips (
        id INTEGER PRIMARY KEY, sha256 TEXT NOT NULL, settings TEXT NOT NULL, name TEXT NOT NULL,
        began_utc TEXT, duration_s REAL NOT NULL, frames INTEGER NOT NULL, version TEXT NOT NULL,
        UNIQUE (sha256, settings));
    CREATE TABLE vehicles (
        clip INTEGER NOT NULL REFERENCES clips ON DELETE CASCADE, track_id INTEGER NOT NULL, t_start REAL NOT NULL,
        t_end REAL NOT NULL, time_utc TEXT, direction REAL NOT NULL, lane INTEGER, speed_kmh REAL NOT NULL,
        ci95_low_kmh REAL NOT NULL, ci95_high_kmh REAL NOT NULL, distance_m REAL NOT NULL, n_frames INTEGER NOT NULL,
        PRIMARY KEY (clip, track_id)) WITHOUT ROWID;
    """,
    """
    CREATE TABLE files (
        path TEXT PRIMARY KEY, size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL, ctime_ns INTEGER NOT NULL,
        inode INTEGER NOT NULL, sha256 TEXT NOT NULL) WITHOUT ROWID;
    """,
)
VERSION = len(MIGRATIONS)


@dataclass(frozen=True, slots=True)
class LoggedClip:
    """One recording as the log keeps it; `settings` is the hash of everything else that its speeds depend on."""

    sha256: str
    settings: str
    name: str
    began_utc: str | None
    duration_s: float
    frames: int
    version: str


class TrafficLog:
    """`with TrafficLog(path) as log:` opens a log for adding, and makes it where there is none.

    Several writers may share it: each waits for the other. Raises InputError where the file is no log or one of a
    newer version, OutputError where it cannot be written, BusyError where another writer holds it for a minute.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> TrafficLog:
        with self._problems():
            self._base = sqlite3.connect(self.path, timeout=WAIT_S, isolation_level=None)
            self._base.execute("PRAGMA foreign_keys = ON")
            _migrate(self._base, self.path)
        return self

    def __exit__(self, *_: object) -> None:
        self._base.close()

    def holds(self, sha256: str, settings: str) -> bool:
        """Whether a recording was added with these settings."""
        with self._problems():
            found = self._base.execute("SELECT 1 FROM clips WHERE sha256 = ? AND settings = ?", (sha256, settings))
            return found.fetchone() is not None

    def digest(self, path: Path) -> str:
        """The SHA-256 of a recording; one that has not changed since it was last asked for is not read again."""
        known = (os.fsencode(os.path.abspath(path)), *_state(path))
        kept = "path = ? AND size = ? AND mtime_ns = ? AND ctime_ns = ? AND inode = ?"
        with self._problems():
            found = self._base.execute(f"SELECT sha256 FROM files WHERE {kept}", known).fetchone()
        if found is not None:
            return str(found[0])
        digest = str(describe(path)["sha256"])
        if _state(path) == known[1:]:  # it was not written to meanwhile
            with self._problems():
                self._base.execute("INSERT OR REPLACE INTO files VALUES (?, ?, ?, ?, ?, ?)", (*known, digest))
        return digest

    def add(self, clip: LoggedClip, vehicles: Sequence[Mapping[str, Any]]) -> bool:
        """Add a recording and its rows of speeds.csv in one transaction; False, and nothing, where it is there."""
        with self._problems(), self._transaction():
            if self.holds(clip.sha256, clip.settings):
                return False
            values = (clip.sha256, clip.settings, clip.name, clip.began_utc, clip.duration_s, clip.frames, clip.version)
            done = self._base.execute(
                "INSERT INTO clips (sha256, settings, name, began_utc, duration_s, frames, version) "
                "VALUES (?, ?, ?, ?, ?, ?, ?)",
                values,
            )
            self._base.executemany(
                f"INSERT INTO vehicles (clip, {', '.join(FIELDS)}) VALUES ({', '.join('?' * (len(FIELDS) + 1))})",
                [(done.lastrowid, *(row[name] if row[name] != "" else None for name in FIELDS)) for row in vehicles],
            )
        return True

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._base.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._base.execute("COMMIT")
        except BaseException:
            with suppress(sqlite3.Error):
                self._base.execute("ROLLBACK")
            raise

    @contextmanager
    def _problems(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.DatabaseError as problem:
            text = str(problem)
            if "locked" in text:
                raise BusyError(f"{self.path}: another run holds the log; try again later") from problem
            if "not a database" in text or "malformed" in text:
                raise InputError(f"{self.path}: not a traffic log (SQLite): {text}") from problem
            raise OutputError(f"{self.path}: the log cannot be written: {text}") from problem


def read(path: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Clips and vehicles of a log, by clip name, t_start and track_id; of each clip only what was added last.

    Raises InputError where it is missing or no log.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such log; `visfuse speed --log` writes one")
    try:
        # What a killed writer left half done is rolled back on reading, which takes the right to write.
        mode = "rw" if os.access(path, os.W_OK) and os.access(path.resolve().parent, os.W_OK) else "ro"
        base = sqlite3.connect(f"{path.resolve().as_uri()}?mode={mode}", uri=True, timeout=WAIT_S)
        try:
            _check(base, path)
            base.row_factory = sqlite3.Row
            base.execute("BEGIN")
            latest = "(SELECT max(id) FROM clips GROUP BY sha256)"
            clips = base.execute(f"SELECT * FROM clips WHERE id IN {latest} ORDER BY name, sha256").fetchall()
            vehicles = base.execute(
                f"SELECT clips.name AS clip_name, clips.sha256, vehicles.* FROM vehicles JOIN clips ON clip = id "
                f"WHERE clip IN {latest} ORDER BY clips.name, clips.sha256, t_start, track_id"
            ).fetchall()
        finally:
            base.close()
    except sqlite3.DatabaseError as problem:
        raise InputError(f"{path}: not a traffic log that can be read: {problem}") from problem
    for row in (*clips, *vehicles):
        if not _sound(row):
            raise InputError(f"{path}: holds what no run has written: {dict(row)}")
    return [dict(row) for row in clips], [dict(row) for row in vehicles]


def _sound(row: sqlite3.Row) -> bool:
    """Whether a row holds numbers where numbers belong, and times with their offset."""
    numbers = [row[name] for name in row.keys() if name in NUMBERS]  # noqa: SIM118  (a Row iterates over its values)
    moment = row["time_utc"] if "time_utc" in row.keys() else row["began_utc"]  # noqa: SIM118
    try:
        aware = moment is None or datetime.fromisoformat(moment).tzinfo is not None
        return aware and all(abs(number) <= LARGEST for number in numbers if number is not None)
    except (TypeError, ValueError):
        return False


def _state(path: Path) -> tuple[int, int, int, int]:
    """What changes when a file does: size, times of its content and its entry (ns), inode."""
    try:
        found = path.stat()
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror}") from problem
    return found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino


def _check(base: sqlite3.Connection, path: Path) -> int:
    """The log's version; raises InputError where it is no log or newer than this program."""
    application = base.execute("PRAGMA application_id").fetchone()[0]
    version = int(base.execute("PRAGMA user_version").fetchone()[0])
    if application != APPLICATION:
        raise InputError(f"{path}: is a database, but not a traffic log of visfuse; give another file")
    if version > VERSION:
        raise InputError(f"{path}: was written by a newer visfuse (log version {version}, this one knows {VERSION})")
    return version


def _migrate(base: sqlite3.Connection, path: Path) -> None:
    base.execute("BEGIN IMMEDIATE")
    try:
        fresh = base.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
        version = 0 if fresh else _check(base, path)
        for step in MIGRATIONS[version:]:
            for statement in filter(str.strip, step.split(";")):
                base.execute(statement)
        base.execute(f"PRAGMA application_id = {APPLICATION}")
        base.execute(f"PRAGMA user_version = {VERSION}")
        base.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):
            base.execute("ROLLBACK")
        raise
