"""The report's tables as text: figures at the top, one row a vehicle, groups by lane and direction, cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.maths.percentiles import pace, percentile
from visfuse_cli.maths.speed import KMH
from visfuse_cli.records import Array
from visfuse_cli.report.folder import RunView, TrackView

PACE_KMH = 16.09344  # ten miles an hour, as traffic engineers use it
SECTOR = 45.0  # degrees
UNITS = {"km/h": KMH, "mph": 2.2369362920544, "m/s": 1.0}
TOLD = {  # what some commands say of a track beyond its speed: key of the summary, head, format
    "height": ("height m", "{:.2f}"),
    "reprojection_px": ("off px", "{:.1f}"),
    "size": ("size m", "{}"),
    "ended": ("ended", "{}"),
}


@dataclass(frozen=True, slots=True)
class Shown:
    """How speeds are shown: the unit's name, and what m/s are multiplied by."""

    name: str
    factor: float

    def of_kmh(self, speeds: Any) -> Any:
        """km/h in this unit."""
        return speeds / KMH * self.factor


def shown_units(document: dict[str, Any]) -> Shown:
    """The unit that the run's configuration asks for."""
    name = document.get("config", {}).get("display", {}).get("units", "m/s")
    return Shown(name, UNITS.get(name, 1.0))


def speeds_kmh(rows: list[dict[str, str]]) -> Array:
    """Speeds (n,) km/h of rows of speeds.csv."""
    return np.array([float(row["speed_kmh"]) for row in rows])


def figures(run: RunView, accepted: list[TrackView], units: Shown) -> list[tuple[str, str]]:
    """The few numbers at the top."""
    if not run.rows:
        found = [("tracks", str(len(accepted)))]
        speeds = [track.summary["speed"] for track in accepted if track.summary.get("speed") is not None]
        if speeds:
            found.append(("mean speed", f"{np.mean(speeds) * units.factor:.2f} {units.name}"))
        return found + ([("rejected", str(len(run.rejected)))] if run.rejected else [])
    numbers = _numbers(units.of_kmh(speeds_kmh(run.rows)), units)
    heads = ["vehicles", *(f"{head}, {units.name}" for head in ("mean", "50th percentile", "85th percentile", "pace"))]
    return [*zip(heads, numbers, strict=True), ("rejected", str(len(run.rejected)))]


def _numbers(speeds: Array, units: Shown) -> list[str]:
    """Count, mean, 50th and 85th percentile with their intervals, and pace of speeds (n,)."""
    cells = [str(len(speeds)), f"{speeds.mean():.1f}"]
    for share in (0.5, 0.85):
        value, low, high = percentile(speeds, share)
        ends = "-".join("?" if end is None else f"{end:.1f}" for end in (low, high))
        cells.append(f"{value:.1f} [{ends}]")
    width = float(units.of_kmh(PACE_KMH))
    first, held = pace(speeds, width)
    return [*cells, f"{first:.0f}-{first + width:.0f} ({100 * held:.0f} %)"]


def groups(run: RunView, units: Shown) -> list[list[str]]:
    """Lane, direction and numbers, a row each; empty where all vehicles are of one kind."""
    keys = [(row["lane"] or "", round(float(row["direction"] or 0) / SECTOR) % round(360 / SECTOR)) for row in run.rows]
    table = []
    for lane, sector in sorted(set(keys), key=lambda key: (int(key[0] or 0), key[1])):
        speeds = speeds_kmh([row for row, key in zip(run.rows, keys, strict=True) if key == (lane, sector)])
        table.append([lane or "-", f"{sector * SECTOR:.0f}\u00b0", *_numbers(units.of_kmh(speeds), units)])
    return table if len(table) > 1 else []


def columns(run: RunView, accepted: list[TrackView]) -> list[str]:
    """Heads of the table of vehicles or tracks."""
    clip = ["clip"] if _clipped(run, accepted) else []
    first = ["id", *clip, "from", "to", "speed", "95 % interval"]
    if run.rows:
        return [*first, "direction", "lane", "way m", "frames"]
    return [*first, "way m", "frames", *(head for head, _ in _told(accepted).values())]


def _clipped(run: RunView, accepted: list[TrackView]) -> bool:
    return bool(run.rows) or any(track.clip for track in accepted)


def _told(accepted: list[TrackView]) -> dict[str, tuple[str, str]]:
    return {key: told for key, told in TOLD.items() if any(track.summary.get(key) is not None for track in accepted)}


def rows(run: RunView, accepted: list[TrackView], units: Shown) -> list[dict[str, Any]]:
    """Table rows as text, with the track and the time that a click seeks."""
    if run.rows:
        return [_vehicle(row, units) for row in run.rows]
    return [_track(track, units, _clipped(run, accepted), _told(accepted)) for track in accepted]


def _vehicle(row: dict[str, str], units: Shown) -> dict[str, Any]:
    speed, low, high = (
        f"{units.of_kmh(float(row[key])):.1f}" for key in ("speed_kmh", "ci95_low_kmh", "ci95_high_kmh")
    )
    cells = [row["track_id"], row["clip"], f"{float(row['t_start']):.2f}", f"{float(row['t_end']):.2f}"]
    cells += [speed, f"{low}-{high}", row["direction"], row["lane"], row["distance_m"], row["n_frames"]]
    return {
        "seek": float(row["t_start"]),
        "track": int(row["track_id"]),
        "clip": Path(row["clip"]).stem,
        "cells": cells,
    }


def _track(track: TrackView, units: Shown, clipped: bool, told: dict[str, tuple[str, str]]) -> dict[str, Any]:
    summary = track.summary
    low, high = (units.factor * end for end in summary.get("speed_ci95") or (np.nan, np.nan))
    cells = [str(track.id), *([track.clip] if clipped else []), f"{track.t[0]:.2f}", f"{track.t[-1]:.2f}"]
    cells += [f"{summary.get('speed', np.nan) * units.factor:.2f}", f"{low:.2f}-{high:.2f}"]
    cells += [f"{summary.get('distance', np.nan):.2f}", str(summary.get("n_frames", ""))]
    cells += [_cell(summary.get(key), form) for key, (_, form) in told.items()]
    return {"seek": float(track.t[0]), "track": track.id, "clip": Path(track.clip).stem, "cells": cells}


def _cell(value: Any, form: str) -> str:
    if isinstance(value, list):
        return " x ".join(f"{side:.1f}" for side in value)
    return "" if value is None else form.format(value)


def cameras(run: RunView) -> list[list[str]]:
    """What each of several cameras added, a row each."""
    told: dict[str, dict[str, Any]] = run.document.get("summary", {}).get("per_camera", {})
    offsets = run.document.get("summary", {}).get("offsets", {})
    return [
        [
            name,
            str(camera.get("sightings", "")),
            f"{100 * (camera.get('share') or 0):.0f} %",
            _cell(camera.get("reprojection_px"), "{:.1f}"),
            _cell(camera.get("shift_px"), "{}").replace(" x ", ", "),
            _cell(camera.get("late_s"), "{:+.2f}"),
            _cell(offsets.get(name), "{:+.3f}"),
        ]
        for name, camera in told.items()
    ]
