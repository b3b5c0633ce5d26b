"""What an evaluation reads: the tracks of a run folder, truth.csv, a table of reference speeds."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.records import Array

TRUTH = ("frame", "t", "id", "x", "y", "z", "vx", "vy", "vz")


@dataclass(frozen=True, slots=True)
class Estimates:
    """All states of a run, N rows: frame (N,), id (N,), position (N, 2 or 3), velocity, covariance, speed and sigma."""

    frame: Array
    id: Array
    position: Array
    velocity: Array
    covariance: Array
    speed: Array
    speed_sigma: Array
    summaries: list[dict[str, Any]]


def read_run(folder: Path) -> Estimates:
    """The accepted tracks of a run folder; raises InputError where it is none."""
    path = folder / "tracks.json"
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        tracks = [track for track in document["tracks"] if not track["summary"].get("rejected")]
        states = [(track["id"], state) for track in tracks for state in track["states"]]
        size = len(states[0][1]["position"]) if states else 3
        column = lambda key: np.array([state[key] for _, state in states], dtype=float)  # noqa: E731
        return Estimates(
            frame=column("frame"),
            id=np.array([identity for identity, _ in states], dtype=float),
            position=column("position").reshape(-1, size),
            velocity=column("velocity").reshape(-1, size),
            covariance=column("covariance").reshape(-1, 2 * size, 2 * size),
            speed=column("speed"),
            speed_sigma=column("speed_sigma"),
            summaries=[track["summary"] for track in tracks],
        )
    except OSError as problem:
        raise InputError(
            f"{path}: cannot be read: {problem.strerror or problem}; RUN is the folder of a run"
        ) from problem
    except (ValueError, KeyError, TypeError) as problem:
        raise InputError(f"{path}: not the tracks of a run: {problem!r}") from problem


def read_table(path: Path, needed: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Array]:
    """Columns by name (n,) of a CSV file, NaN where a cell is empty; raises InputError naming line and column."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            names = reader.fieldnames or []
            missing = [name for name in needed if name not in names]
            if missing:
                raise InputError(f"{path}, line 1: column {missing[0]} is missing; needed are {','.join(needed)}")
            wanted = [name for name in (*needed, *optional) if name in names]
            rows = [_row(path, number, row, wanted) for number, row in enumerate(reader, start=2)]
    except (UnicodeDecodeError, csv.Error) as problem:
        raise InputError(f"{path}: not a text table") from problem
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror or problem}") from problem
    if not rows:
        raise InputError(f"{path}: has no rows")
    return {name: np.array([row[name] for row in rows]) for name in wanted}


def _row(path: Path, number: int, row: dict[str, Any], wanted: list[str]) -> dict[str, float]:
    values = {}
    for name in wanted:
        text = (row.get(name) or "").strip()
        try:
            values[name] = float(text) if text else np.nan
        except ValueError:
            raise InputError(f"{path}, line {number}, column {name}: '{text[:40]}' is not a number") from None
        if np.isinf(values[name]):
            raise InputError(f"{path}, line {number}, column {name}: {text} is not finite")
    return values
