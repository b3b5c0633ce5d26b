"""A run of `visfuse speed` held against the truth of its scene."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rows(path: Path) -> list[dict[str, str]]:
    """A CSV file as one dict a row."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def matches(run: Path, truth: Path, reach_m: float = 2.0) -> list[tuple[dict[str, str], float, float, int | None]]:
    """For each row: itself, the true mean speed over its own stretch, the share of time within reach, the vehicle."""
    tracks = {track["id"]: track for track in json.loads((run / "tracks.json").read_text())["tracks"]}
    true = _states(truth)
    # a track may begin where the vehicle is hardly in the picture yet; its speed there is wanted all the same
    drives = _states(truth.with_name("drives.csv")) if truth.with_name("drives.csv").exists() else true
    found = []
    for row in rows(run / "speeds.csv"):
        states = tracks[int(row["track_id"])]["states"]
        t = np.array([s["t"] for s in states])
        xy = np.array([s["position"] for s in states])
        best: tuple[float, int | None, float] = (0.0, None, np.nan)
        for vehicle, v in true.items():
            at = [np.interp(v[:, 0], t, xy[:, k], left=np.nan, right=np.nan) for k in (0, 1)]
            share = float(np.mean(np.hypot(at[0] - v[:, 1], at[1] - v[:, 2]) < reach_m))
            if share > best[0]:
                best = (share, vehicle, _mean_speed(drives[vehicle], float(row["t_start"]), float(row["t_end"])))
        found.append((row, best[2], best[0], best[1]))
    return found


def heading_errors(run: Path, truth: Path, after_s: float = 1.0) -> list[float]:
    """Degrees (mod a half turn) by which the tracks with a row err where measured, from `after_s` s of a track on."""
    tracks = {track["id"]: track for track in json.loads((run / "tracks.json").read_text())["tracks"]}
    facing = {(int(r["id"]), int(r["frame"])): float(r["heading"]) for r in rows(truth.with_name("drives.csv"))}
    errors = []
    for row, _, share, vehicle in matches(run, truth):
        if vehicle is None or share < 0.5:
            continue
        states = tracks[int(row["track_id"])]["states"]
        for state in states:
            if state["measured"] and state["t"] - states[0]["t"] >= after_s:
                off = state["heading"] - facing[vehicle, state["frame"]]
                errors.append(abs(float(np.degrees((off + np.pi / 2) % np.pi - np.pi / 2))))
    return errors


def _states(path: Path) -> dict[int, Array]:
    """Vehicle -> (n, 5) t, x, y, vx, vy."""
    states: dict[int, list[list[float]]] = {}
    for row in rows(path):
        states.setdefault(int(row["id"]), []).append([float(row[k]) for k in ("t", "x", "y", "vx", "vy")])
    return {vehicle: np.array(values) for vehicle, values in states.items()}


def _mean_speed(states: Array, begin: float, end: float) -> float:
    """Way by time (km/h) between two times (s) that lie on frames."""
    inside = (states[:, 0] >= begin - 1e-6) & (states[:, 0] <= end + 1e-6)
    speed = np.hypot(states[inside, 3], states[inside, 4])
    return float(np.mean((speed[1:] + speed[:-1]) / 2) * 3.6)
