"""The page itself: figures, tables and what the script needs to follow the video."""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape
from scipy.stats import chi2

from visfuse_cli import __version__
from visfuse_cli.files.atomic import write_text
from visfuse_cli.maths.percentiles import pace, percentile
from visfuse_cli.maths.speed import KMH
from visfuse_cli.records import Array
from visfuse_cli.report import plots
from visfuse_cli.report.folder import RunView, TrackView, read

EMBEDDED_BYTES = 30_000_000  # a larger video is linked, beside the page
MAP_HZ = 12.5  # of positions on the map
UNITS = {"km/h": KMH, "mph": 2.2369362920544, "m/s": 1.0}
NAME = "report.html"


def write(folders: Sequence[Path], out: Path | None = None) -> Path:
    """Write one page about runs, to their folder where it is one; raises InputError, OutputError."""
    page = out or (folders[0] / NAME if len(folders) == 1 else Path(NAME))
    runs = [_section(number, read(folder), page) for number, folder in enumerate(folders)]
    environment = Environment(
        loader=PackageLoader("visfuse_cli.report", "."),
        autoescape=select_autoescape(default=True),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = environment.get_template("template.html").render(runs=runs, version=__version__)
    write_text(page, text)
    return page


def _section(number: int, run: RunView, page: Path) -> dict[str, Any]:
    """All that the template shows of one run."""
    document = run.document
    units = document.get("config", {}).get("display", {}).get("units", "m/s")
    factor = UNITS.get(units, 1.0)
    accepted = [track for track in run.tracks if not track.summary.get("rejected")]
    return {
        "key": f"run{number}",
        "name": run.folder.resolve().name,
        "document": document,
        "units": units,
        "figures": _figures(run, accepted, factor, units),
        "videos": [_video(name, path, page) for name, path in run.videos.items()],
        "clips": _clips(run),
        "columns": _columns(run),
        "rows": _rows(run, accepted, factor, units),
        "rejected": run.rejected,
        "histogram": plots.histogram(_speeds(run), factor / KMH, units) if run.rows else "",
        "speeds": plots.speeds(accepted, factor, units) if accepted else "",
        "models": plots.models(accepted),
        "consistency": _consistency(accepted),
        "calibration": _data_uri(run.calibration, "image/png") if run.calibration else "",
        "warnings": document.get("warnings", []),
        "config": json.dumps(document.get("config", {}), indent=2, ensure_ascii=False),
        "data": _map_data(run.tracks),
    }


def _speeds(run: RunView) -> Any:
    return np.array([float(row["speed_kmh"]) for row in run.rows])


def _figures(run: RunView, accepted: list[TrackView], factor: float, units: str) -> list[tuple[str, str]]:
    """The few numbers at the top."""
    if not run.rows:
        return [("tracks", str(len(accepted)))]
    speeds = _speeds(run) / KMH * factor
    found = [("vehicles", str(len(speeds))), ("mean", f"{speeds.mean():.1f} {units}")]
    for share in (0.5, 0.85):
        value, low, high = percentile(speeds, share)
        ends = "-".join("?" if end is None else f"{end:.1f}" for end in (low, high))
        found.append((f"{100 * share:.0f}th percentile", f"{value:.1f} {units} [{ends}]"))
    first, held = pace(speeds, plots.PACE_KMH / KMH * factor)
    width = plots.PACE_KMH / KMH * factor
    found.append(("pace", f"{first:.0f}-{first + width:.0f} {units} ({100 * held:.0f} %)"))
    return [*found, ("rejected", str(len(run.rejected)))]


def _clips(run: RunView) -> list[dict[str, Any]]:
    return [{"name": name, **audit} for name, audit in run.document.get("time_audit", {}).items()]


def _columns(run: RunView) -> list[str]:
    if run.rows:
        return ["id", "clip", "from", "to", "speed", "95 % interval", "direction", "lane", "way", "frames"]
    return ["id", "clip", "from", "to", "speed", "95 % interval", "way", "frames"]


def _rows(run: RunView, accepted: list[TrackView], factor: float, units: str) -> list[dict[str, Any]]:
    """Table rows as text, with the track and the time that a click seeks."""
    if run.rows:
        return [
            {
                "seek": float(row["t_start"]),
                "track": int(row["track_id"]),
                "clip": Path(row["clip"]).stem,
                "cells": [
                    row["track_id"],
                    row["clip"],
                    row["t_start"],
                    row["t_end"],
                    f"{float(row['speed_kmh']) / KMH * factor:.1f}",
                    f"{float(row['ci95_low_kmh']) / KMH * factor:.1f}-{float(row['ci95_high_kmh']) / KMH * factor:.1f}",
                    row["direction"],
                    row["lane"],
                    row["distance_m"],
                    row["n_frames"],
                ],
            }
            for row in run.rows
        ]
    rows = []
    for track in accepted:
        summary = track.summary
        low, high = summary.get("speed_ci95") or (np.nan, np.nan)
        rows.append(
            {
                "seek": float(track.t[0]),
                "track": track.id,
                "clip": Path(track.clip).stem,
                "cells": [
                    str(track.id),
                    track.clip,
                    f"{track.t[0]:.2f}",
                    f"{track.t[-1]:.2f}",
                    f"{summary.get('speed', np.nan) * factor:.2f}",
                    f"{low * factor:.2f}-{high * factor:.2f}",
                    f"{summary.get('distance', np.nan):.2f}",
                    str(summary.get("n_frames", "")),
                ],
            }
        )
    return rows


def _consistency(tracks: list[TrackView]) -> str:
    """Whether the innovations are as large as the filter says, over all tracks that tell."""
    summaries = [track.summary for track in tracks]
    told = [(s["nis_mean"], s["n_frames"], s["nis_dof"]) for s in summaries if s.get("nis_mean") and s.get("nis_dof")]
    if not told:
        return ""
    table: Array = np.array(told, dtype=float)
    mean, count, size = table[:, 0], table[:, 1], table[:, 2]
    freedom = float((count * size).sum())
    ratio = float((mean * count).sum()) / freedom
    low, high = (float(chi2.ppf(share, freedom)) / freedom for share in (0.0005, 0.9995))
    verdict = "consistent" if low <= ratio <= high else ("cautious" if ratio < low else "too sure of itself")
    return (
        f"normalised innovation squared {ratio:.2f} per degree of freedom (99.9 % band {low:.2f}-{high:.2f}): {verdict}"
    )


def _video(name: str, path: Path, page: Path) -> dict[str, str]:
    large = path.stat().st_size > EMBEDDED_BYTES
    here = os.path.relpath(path.resolve(), page.resolve().parent)
    return {"name": name, "source": here if large else _data_uri(path, "video/mp4"), "linked": here if large else ""}


def _data_uri(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _map_data(tracks: list[TrackView]) -> str:
    """Positions for the map: by track its clip and rows of t, right, up (m), thinned."""
    shown = []
    for track in tracks:
        ground = (
            track.position[:, [0, 2]]
            if track.position.shape[1] == 3 and _looks_forward(track)
            else track.position[:, :2]
        )
        spacing = float(np.median(np.diff(track.t))) if len(track.t) > 1 else 1.0
        each = max(1, round(1 / (MAP_HZ * max(spacing, 1e-6))))
        rows = np.column_stack([track.t, ground])[::each]
        shown.append(
            {
                "id": track.id,
                "clip": Path(track.clip).stem,
                "rejected": bool(track.summary.get("rejected")),
                "path": np.round(rows, 3).tolist(),
            }
        )
    # `</script>` in a clip's name must not end the script
    return json.dumps(shown, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _looks_forward(track: TrackView) -> bool:
    """Whether the third coordinate is the way ahead (a camera's frame) and not the height (a world with z up)."""
    return bool(np.ptp(track.position[:, 2]) > np.ptp(track.position[:, 1]))
