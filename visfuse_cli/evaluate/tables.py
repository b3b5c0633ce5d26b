"""What an evaluation reads: the tracks of a run folder, truth.csv, a table of reference speeds."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.errors import InputError
from visfuse_cli.records import Array

TRUTH = ("frame", "id", "x", "y")
TRUTH_MORE = ("t", "z", "vx", "vy", "vz")
RADAR = ("t", "speed_kmh")
RADAR_MORE = ("direction", "lane")
LARGEST = 1e12  # beyond, squares of it would not be numbers
CAMERA_FRAMES = ("left-camera", "left-camera-at-start")  # x right, y down, z ahead


@dataclass(frozen=True, slots=True)
class Estimates:
    """All states of a run, N rows: clip and frame (N,), id (N,), position (N, 2 or 3), velocity, covariance, speed."""

    clip: NDArray[np.str_]
    frame: Array
    id: Array
    position: Array
    velocity: Array
    covariance: Array
    speed: Array
    speed_sigma: Array
    tracks: list[dict[str, Any]]  # without their states
    axes: Array  # (2, dims): coordinates on the ground


@dataclass(frozen=True, slots=True)
class Table:
    """Columns (n,) of a CSV file by name, NaN where a cell is empty, and the clip of each row, empty without one."""

    columns: dict[str, Array]
    clip: NDArray[np.str_]
    line: list[int]  # of each row in the file

    def stack(self, names: tuple[str, ...]) -> Array:
        """Columns (n, k), NaN for those that the file lacks."""
        lacking = np.full(len(self.clip), np.nan)
        return np.column_stack([self.columns.get(name, lacking) for name in names])


def read_run(folder: Path) -> Estimates:
    """The accepted tracks of a run folder; raises InputError where it is none."""
    path = folder / "tracks.json"
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        tracks = [track for track in document["tracks"] if not track["summary"].get("rejected")]
        return _estimates(tracks, _axes(folder, str(document.get("frame_of_reference", ""))))
    except OSError as problem:
        raise InputError(
            f"{path}: cannot be read: {problem.strerror or problem}; RUN is the folder of a run"
        ) from problem
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as problem:
        raise InputError(f"{path}: not the tracks of a run: {problem!r}") from problem


def _estimates(tracks: list[dict[str, Any]], normal: Array) -> Estimates:
    states = [(track, state) for track in tracks for state in track["states"]]
    size = len(states[0][1]["position"]) if states else 3

    def column(key: str, *shape: int) -> Array:
        values = np.array([state[key] for _, state in states], dtype=float).reshape(len(states), *shape)
        if not np.isfinite(values).all():
            raise ValueError(f"{key} is not finite")
        return values

    for track in tracks:
        float(track["summary"]["speed"]), float(track["summary"]["t_start"]), float(track["summary"]["t_end"])
    return Estimates(
        clip=np.array([str(track.get("clip", "")) for track, _ in states], dtype=np.str_),
        frame=column("frame"),
        id=np.array([track["id"] for track, _ in states], dtype=float),
        position=column("position", size),
        velocity=column("velocity", size),
        covariance=column("covariance", 2 * size, 2 * size),
        speed=column("speed"),
        speed_sigma=column("speed_sigma"),
        tracks=[{key: value for key, value in track.items() if key != "states"} for track in tracks],
        axes=np.eye(2) if size == 2 else _on_plane(normal),
    )


def _axes(folder: Path, reference: str) -> Array:
    """The ground's normal (3,): the camera's y axis, or that of the plane people stood on."""
    if reference in CAMERA_FRAMES:
        return np.array([0.0, 1.0, 0.0])
    try:
        run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        normal = np.array(run["config"]["world"]["ground"][:3], dtype=float)
        return normal / np.linalg.norm(normal)
    except (OSError, ValueError, KeyError, TypeError):
        return np.array([0.0, 0.0, 1.0])


def _on_plane(normal: Array) -> Array:
    """Two unit vectors (2, 3) across a normal, as near as can be to the coordinate axes least along it."""
    first, second = np.sort(np.argsort(np.abs(normal), kind="stable")[:2])
    across = np.eye(3)[first] - normal[first] * normal
    across /= np.linalg.norm(across)
    other = np.eye(3)[second] - normal[second] * normal
    other -= (other @ across) * across
    return np.stack([across, other / np.linalg.norm(other)])


def read_truth(path: Path) -> Table:
    """truth.csv; raises InputError naming line and column, also where a place is unknown or somebody is there twice."""
    table = _read(path, TRUTH, TRUTH_MORE, needed_cells=TRUTH)
    seen: dict[tuple[str, float, float], int] = {}
    for line, *key in zip(table.line, table.clip, table.columns["frame"], table.columns["id"], strict=True):
        before = seen.setdefault((str(key[0]), float(key[1]), float(key[2])), line)
        if before != line:
            raise InputError(f"{path}, line {line}: id {key[2]:g} is in frame {key[1]:g} already, by line {before}")
    return table


def read_radar(path: Path) -> Table:
    """radar.csv; raises InputError naming line and column."""
    table = _read(path, RADAR, RADAR_MORE, needed_cells=RADAR)
    for line, speed in zip(table.line, table.columns["speed_kmh"], strict=True):
        if speed < 0:
            raise InputError(f"{path}, line {line}, column speed_kmh: {speed:g} is below zero; direction is a column")
    return table


def _read(path: Path, needed: tuple[str, ...], optional: tuple[str, ...], needed_cells: tuple[str, ...]) -> Table:
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            reader.fieldnames = names = [name.strip() for name in reader.fieldnames or []]
            missing = [name for name in needed if name not in names]
            if missing:
                raise InputError(f"{path}, line 1: column {missing[0]} is missing; needed are {','.join(needed)}")
            rows = [(reader.line_num, row) for row in reader]
    except (UnicodeDecodeError, csv.Error) as problem:
        raise InputError(f"{path}: not a text table") from problem
    except OSError as problem:
        raise InputError(f"{path}: cannot be read: {problem.strerror or problem}") from problem
    if not rows:
        raise InputError(f"{path}: has no rows")
    wanted = [name for name in (*needed, *optional) if name in names]
    values = [[_number(path, line, row, name, name in needed_cells) for name in wanted] for line, row in rows]
    columns = dict(zip(wanted, np.array(values).T, strict=True))
    clip = np.array([(row.get("clip") or "").strip() for _, row in rows], dtype=np.str_)
    return Table(columns, clip, [line for line, _ in rows])


def _number(path: Path, line: int, row: dict[str, Any], name: str, needed: bool) -> float:
    text = (row.get(name) or "").strip()
    where = f"{path}, line {line}, column {name}"
    try:
        value = float(text) if text else np.nan
    except ValueError:
        raise InputError(f"{where}: '{text[:40]}' is not a number") from None
    if np.isinf(value) or (text and np.isnan(value)):
        raise InputError(f"{where}: {text} is not finite")
    if abs(value) > LARGEST:
        raise InputError(f"{where}: {text[:40]} is not a place, a time or a speed")
    if needed and not text:
        raise InputError(f"{where}: is empty")
    return value
