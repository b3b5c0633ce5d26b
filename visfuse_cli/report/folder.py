"""What a run folder holds, read for the report: every file is optional but run.json."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.lanes_file import read_lanes
from visfuse_cli.files.spool import without_covariance
from visfuse_cli.maths.polygons import Polygon
from visfuse_cli.records import Array

DOCUMENT = {"versions": dict, "config": dict, "time_audit": dict, "summary": dict, "inputs": list, "warnings": list}
NEEDED = ("versions", "inputs")
NUMBERS = ("track_id", "t_start", "t_end", "direction", "speed_kmh", "ci95_low_kmh", "ci95_high_kmh")


@dataclass(frozen=True, slots=True)
class TrackView:
    """One track as the report shows it: t (T,) s, position (T, 2 or 3) m, speed and its deviation (T,) m/s."""

    id: int
    clip: str
    summary: dict[str, Any]
    t: Array
    position: Array
    speed: Array
    speed_sigma: Array
    measured: Array
    models: dict[str, Array]


@dataclass(frozen=True, slots=True)
class RunView:
    """One run: its document, tracks, tables, videos by clip or view, calibration picture and lanes if there are any."""

    folder: Path
    document: dict[str, Any]
    frame_of_reference: str
    tracks: list[TrackView]
    rows: list[dict[str, str]]
    rejected: list[dict[str, str]]
    videos: dict[str, Path]
    calibration: Path | None
    lanes: tuple[Polygon, ...]


def read(folder: Path) -> RunView:
    """Read a run folder; raises InputError where it is none, or a file in it is damaged."""
    if not (folder / "run.json").is_file():
        raise InputError(f"{folder}: not a run folder: it has no run.json")
    document = _json(folder / "run.json")
    for key, kind in DOCUMENT.items():
        if not isinstance(document.get(key, kind()), kind) or (key in NEEDED and key not in document):
            raise InputError(
                f'{folder / "run.json"}: not the file of a run: "{key}" must be there, as a {kind.__name__}'
            )
    tracks = _json(folder / "tracks.json") if (folder / "tracks.json").is_file() else {"tracks": []}
    try:
        views = [_track(track) for track in tracks["tracks"]]
    except (KeyError, TypeError, ValueError, AttributeError) as problem:
        raise InputError(f"{folder / 'tracks.json'}: not the tracks of a run: {problem!r}") from problem
    picture = folder / "calibration.png"
    return RunView(
        folder=folder,
        document=document,
        frame_of_reference=str(tracks.get("frame_of_reference", "")),
        tracks=views,
        rows=_measured(folder / "speeds.csv"),
        rejected=_table(folder / "rejected.csv"),
        videos=_videos(folder),
        calibration=picture if picture.is_file() else None,
        lanes=(read_lanes(lanes) or ()) if (lanes := folder / "lanes.yaml").is_file() else (),
    )


def _json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"), object_hook=without_covariance)
    except (OSError, ValueError, RecursionError) as problem:
        raise InputError(f"{path}: cannot be read: {problem}") from problem
    if not isinstance(document, dict):
        raise InputError(f"{path}: not the file of a run; it holds one JSON object")
    return document


def _table(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    try:
        with open(path, newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except (OSError, ValueError, csv.Error) as problem:
        raise InputError(f"{path}: cannot be read: {problem}") from problem


def _measured(path: Path) -> list[dict[str, str]]:
    """The rows of speeds.csv, their numbers tried."""
    rows = _table(path)
    for number, row in enumerate(rows, start=2):
        for name in NUMBERS:
            try:
                good = np.isfinite(float(row[name]))
            except (KeyError, TypeError, ValueError):
                good = False
            if not good:
                raise InputError(f"{path}, line {number}, column {name}: {row.get(name)!r} is not a number")
    return rows


def _track(track: dict[str, Any]) -> TrackView:
    states = track["states"]
    column = lambda key, default: np.array([state.get(key, default) for state in states], dtype=float)  # noqa: E731
    if not states or not isinstance(track["summary"], dict) or not np.isfinite(column("t", np.nan)).all():
        raise ValueError(f"track {track['id']} has no states, times or summary")
    names = sorted({name for state in states for name in state.get("models", {})})
    return TrackView(
        id=int(track["id"]),
        clip=str(track.get("clip", "")),
        summary=track["summary"],
        t=column("t", np.nan),
        position=np.array([state["position"] for state in states], dtype=float),
        speed=column("speed", np.nan),
        speed_sigma=column("speed_sigma", np.nan),
        measured=column("measured", True),
        models={name: np.array([state.get("models", {}).get(name, 0.0) for state in states]) for name in names},
    )


def _videos(folder: Path) -> dict[str, Path]:
    """Annotated videos by what follows `annotated-`; a single one is called nothing. All cameras at once come first."""
    found = {
        path.stem.removeprefix("annotated").removeprefix("-"): path for path in sorted(folder.glob("annotated*.mp4"))
    }
    mosaic = folder / "mosaic.mp4"
    return ({"all cameras": mosaic} if mosaic.is_file() else {}) | found
