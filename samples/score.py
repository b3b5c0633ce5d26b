"""A run of `visfuse speed` held against the truth of its scene."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np


def rows(path: Path) -> list[dict[str, str]]:
    """A CSV file as one dict a row."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def matches(run: Path, truth: Path, reach_m: float = 2.0) -> list[tuple[dict[str, str], float, float, int | None]]:
    """For each row: itself, the true mean speed over its own stretch, the share of time within reach, the vehicle."""
    tracks = {track["id"]: track for track in json.loads((run / "tracks.json").read_text())["tracks"]}
    true: dict[int, list[list[float]]] = {}
    for row in rows(truth):
        true.setdefault(int(row["id"]), []).append([float(row[k]) for k in ("t", "x", "y", "vx", "vy")])
    found = []
    for row in rows(run / "speeds.csv"):
        states = tracks[int(row["track_id"])]["states"]
        t = np.array([s["t"] for s in states])
        xy = np.array([s["position"] for s in states])
        best: tuple[float, int | None, float] = (0.0, None, np.nan)
        for vehicle, values in true.items():
            v = np.array(values)
            at = [np.interp(v[:, 0], t, xy[:, k], left=np.nan, right=np.nan) for k in (0, 1)]
            share = float(np.mean(np.hypot(at[0] - v[:, 1], at[1] - v[:, 2]) < reach_m))
            if share > best[0]:
                inside = (v[:, 0] >= float(row["t_start"]) - 1e-6) & (v[:, 0] <= float(row["t_end"]) + 1e-6)
                best = (share, vehicle, float(np.hypot(v[inside, 3], v[inside, 4]).mean() * 3.6))
        found.append((row, best[2], best[0], best[1]))
    return found
