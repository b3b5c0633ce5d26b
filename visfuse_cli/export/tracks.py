"""The tracks of a run folder as an export takes them, and as one table with a row a state."""

from __future__ import annotations

import json
import math
import operator
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from visfuse_cli.errors import InputError

AXES = ("x", "y", "z")
FIXED = tuple(
    "clip track_id class rejected frame t x y z vx vy vz sigma_x sigma_y sigma_z speed speed_sigma measured".split()
)
SIDES = ("x", "y", "w", "h")


@dataclass(frozen=True, slots=True)
class Tracks:
    """A run's documents, and its tracks as tracks.json has them, each with at least one state."""

    folder: Path
    run: dict[str, Any]
    frame_of_reference: str
    tracks: list[dict[str, Any]]

    @property
    def clips(self) -> list[str]:
        """The clips that tracks name; of a single recording one nameless clip."""
        return sorted({track.get("clip", "") for track in self.tracks})

    @property
    def views(self) -> list[str]:
        """The views that boxes are in."""
        return sorted({view for track in self.tracks for state in track["states"] for view in state.get("box", {})})


def read(folder: Path, rejected: bool) -> Tracks:
    """A run's tracks, those that were rejected only where asked for; raises InputError where it is no run folder."""
    document, run = (_object(folder / name) for name in ("tracks.json", "run.json"))
    try:
        tracks = [track for track in document["tracks"] if track["states"]]
        tracks = [track for track in tracks if rejected or not track["summary"].get("rejected")]
        found = Tracks(folder, run, str(document.get("frame_of_reference", "")), tracks)
        for row in table(found):  # every state has what a table needs
            if not all(math.isfinite(value) for value in row.values() if isinstance(value, float)):
                raise ValueError(f"track {row['track_id']} holds a number that is not finite")
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as problem:
        raise InputError(f"{folder / 'tracks.json'}: not the tracks of a run: {problem!r}") from problem
    return found


def _object(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as problem:
        raise InputError(
            f"{path}: cannot be read: {problem.strerror or problem}; RUN is the folder of a run"
        ) from problem
    except (ValueError, RecursionError) as problem:
        raise InputError(f"{path}: not JSON: {problem}") from problem
    if not isinstance(document, dict):
        raise InputError(f"{path}: not the file of a run; it holds one JSON object")
    return document


def columns(tracks: Tracks) -> list[str]:
    """The columns of the table: the fixed ones, then the box in each view (px)."""
    return [*FIXED, *(f"box_{view}_{side}" for view in tracks.views for side in SIDES)]


def table(tracks: Tracks) -> Iterator[dict[str, Any]]:
    """One row a state, by clip, track and frame: metres, seconds, m/s; None where a thing is unknown."""
    for track in sorted(tracks.tracks, key=lambda each: (each.get("clip", ""), each["id"])):
        named = {
            "clip": track.get("clip"),
            "track_id": operator.index(track["id"]),
            "class": track.get("class"),
            "rejected": track["summary"].get("rejected"),
        }
        for state in track["states"]:
            yield named | _row(state)


def _row(state: dict[str, Any]) -> dict[str, Any]:
    size = len(state["position"])
    row: dict[str, Any] = {"frame": operator.index(state["frame"]), "measured": bool(state["measured"])}
    row |= {name: state[name] + 0.0 for name in ("t", "speed", "speed_sigma")}  # a text is no number
    for axis, name in enumerate(AXES[:size]):
        row[name], row[f"v{name}"] = float(state["position"][axis]), float(state["velocity"][axis])
        row[f"sigma_{name}"] = math.sqrt(max(state["covariance"][axis][axis], 0.0))
    for view, box in state.get("box", {}).items():
        row |= {f"box_{view}_{side}": float(value) for side, value in zip(SIDES, box, strict=True)}
    return row
