"""A run's speeds beside those of a radar: who belongs to which reading, bias, limits of agreement."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from visfuse_cli.evaluate.tables import Estimates, Table
from visfuse_cli.records import Array

Z95 = 1.959963984540054
KMH = 3.6
NEAR_S = 2.0  # s between a vehicle and the reading that may be of it
TURNED = 90.0  # degrees between courses from which on they are of different vehicles
FAR = 1e6


def against_radar(run: Estimates, radar: Table) -> tuple[dict[str, Any], Array]:
    """What is known of the agreement, km/h, and the pairs (k, 2) of speeds: reference, ours."""
    span = np.array([[t["summary"]["t_start"], t["summary"]["t_end"]] for t in run.tracks], dtype=float).reshape(-1, 2)
    mine = KMH * np.array([t["summary"]["speed"] for t in run.tracks], dtype=float)
    t = radar.columns["t"]
    late = np.maximum(np.abs(t[:, None] - span.mean(axis=1)) - np.diff(span)[:, 0] / 2, 0)
    possible = (late < NEAR_S) & _alike(run, radar)
    # Of several that were there the one whose middle was nearest, never the one whose speed fits best.
    rows, columns = linear_sum_assignment(
        np.where(possible, late + 1e-3 * np.abs(t[:, None] - span.mean(axis=1)), FAR) if len(mine) else late
    )
    good = possible[rows, columns]
    rows, columns = rows[good], columns[good]
    pairs = np.column_stack([radar.columns["speed_kmh"][rows], mine[columns]])
    found: dict[str, Any] = {
        "pairs": len(rows),
        "unmatched_readings": len(t) - len(rows),
        "unmatched_tracks": len(mine) - len(rows),
    }
    off = pairs[:, 1] - pairs[:, 0]
    if len(off):
        low, high = _intervals(run)[columns].T
        inside = (low <= pairs[:, 0]) & (pairs[:, 0] <= high)
        found |= {"bias_kmh": float(off.mean()), "mean_error_kmh": float(np.abs(off).mean())}
        found |= {"worst_kmh": float(np.abs(off).max()), "coverage_95": float(inside.mean())}
    if len(off) > 1:
        spread = float(off.std(ddof=1))
        found["limits_of_agreement_kmh"] = [float(off.mean()) - Z95 * spread, float(off.mean()) + Z95 * spread]
    return found, pairs


def _intervals(run: Estimates) -> Array:
    """Each track's 95 % interval (n, 2) km/h; nothing where it tells none."""
    told = [track["summary"].get("speed_ci95") or [np.nan, np.nan] for track in run.tracks]
    return KMH * np.array(told, dtype=float).reshape(-1, 2)


def _alike(run: Estimates, radar: Table) -> Array:
    """Whether course, lane and clip of a reading and of a track agree (readings, tracks); what is unknown does."""
    agree = np.ones((len(radar.clip), len(run.tracks)), dtype=bool)
    for name in ("direction", "lane"):
        told = radar.columns.get(name, np.full(len(radar.clip), np.nan))[:, None]
        values = [track["summary"].get(name) for track in run.tracks]
        own = np.array([np.nan if value is None else float(value) for value in values])
        if name == "direction":
            differ = np.abs((told - own + 180) % 360 - 180) > TURNED
        else:
            differ = told != own
        agree &= ~(differ & np.isfinite(told) & np.isfinite(own))
    clips = np.array([str(track.get("clip", "")) for track in run.tracks], dtype=np.str_)
    return agree & ((radar.clip[:, None] == clips) | (radar.clip[:, None] == "") | (clips == ""))
