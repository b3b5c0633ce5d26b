"""The page itself: one section a run, and what its script needs to follow the video."""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape

from visfuse_cli import __version__
from visfuse_cli.files.atomic import replacing
from visfuse_cli.files.video_writer import begin_of
from visfuse_cli.maths.consistency import innovations
from visfuse_cli.report import calibration, plots, tables
from visfuse_cli.report.folder import RunView, TrackView, read

EMBEDDED_BYTES = 30_000_000  # of the videos of one run; what goes beyond is linked, beside the page
PIECE = 3 << 16  # bytes of a file that are turned to text at once; by threes, so that the texts go on
MAP_HZ = 12.5  # of positions on the map
NAME = "report.html"
STEREO_FRAME = "left-camera"  # of positions of a pair that stands still: depth is their third number
MEANING = {
    "consistent": "Measurements differ from what was predicted as much as the filter expects.",
    "cautious": "Measurements fit better than the filter expects; its intervals are rather too wide.",
    "too sure of itself": "Measurements fit worse than the filter expects; its intervals are rather too narrow.",
}


def write(folders: Sequence[Path], out: Path | None = None) -> Path:
    """Write one page about runs and calibrations (H.json), beside the one there is; raises InputError, OutputError."""
    page = out or _page_of(folders)
    runs = [
        _calibration(number, path) if path.is_file() else _section(number, read(path), page)
        for number, path in enumerate(folders)
    ]
    environment = Environment(
        loader=PackageLoader("visfuse_cli.report", "."),
        autoescape=select_autoescape(default=True),
        trim_blocks=True,
        lstrip_blocks=True,
    )
    here = resources.files("visfuse_cli.report")
    style, script = ((here / name).read_text(encoding="utf-8") for name in ("style.css", "script.js"))
    pieces = environment.get_template("template.html").generate(
        runs=runs, version=__version__, style=style, script=script, model_colours=plots.MODELS
    )
    with replacing(page, "w") as file:
        file.writelines(pieces)
    return page


def _page_of(folders: Sequence[Path]) -> Path:
    if len(folders) > 1:
        return Path(NAME)
    return folders[0].with_suffix(".html") if folders[0].is_file() else folders[0] / NAME


def _calibration(number: int, path: Path) -> dict[str, Any]:
    shown = calibration.section(path)
    picture = _data_uri(shown["picture"], "image/png") if shown["picture"] else []
    return shown | {"key": f"run{number}", "document": {"command": "calibrate-homography"}, "calibration": picture}


def _section(number: int, run: RunView, page: Path) -> dict[str, Any]:
    """All that the template shows of one run."""
    document = run.document
    units = tables.shown_units(document)
    accepted = [track for track in run.tracks if not track.summary.get("rejected")]
    return {
        "key": f"run{number}",
        "name": run.folder.resolve().name,
        "document": document,
        "units": units.name,
        "figures": tables.figures(run, accepted, units),
        "videos": _videos(run, page),
        "clips": [{"name": name, **audit} for name, audit in document.get("time_audit", {}).items()],
        "columns": tables.columns(run, accepted),
        "rows": tables.rows(run, accepted, units),
        "groups": tables.groups(run, units),
        "cameras": tables.cameras(run),
        "rejected": run.rejected,
        "histogram": plots.histogram(tables.speeds_kmh(run.rows), units) if run.rows else "",
        "speeds": plots.speeds(accepted, units),
        "depths": plots.depths(accepted) if run.frame_of_reference == STEREO_FRAME else [],
        "models": plots.models(accepted),
        "consistency": _consistency(accepted),
        "calibration": _data_uri(run.calibration, "image/png") if run.calibration else [],
        "warnings": document.get("warnings", []),
        "config": json.dumps(document.get("config", {}), indent=2, ensure_ascii=False),
        "data": _map_data(run),
    }


def _consistency(tracks: list[TrackView]) -> list[str]:
    """Whether the filter believes itself as much as it may, in words."""
    summaries = [track.summary for track in tracks]
    found = []
    if told := innovations(summaries):
        low, high = told["band"]
        found.append(
            f"Normalised innovation squared {told['per_degree_of_freedom']:.2f} per degree of freedom "
            f"(99.9 % band {low:.2f}-{high:.2f}): {told['verdict']}. {MEANING[told['verdict']]}"
        )
    if noise := [summary["noise"] for summary in summaries if summary.get("noise") is not None]:
        found.append(
            f"Sightings vary {np.median(noise):.1f} times as much as assumed (median over the tracks, variance); the "
            "covariances are made for what was found."
        )
    return found


def _videos(run: RunView, page: Path) -> list[dict[str, Any]]:
    """Each video in the page itself, as long as all of them stay small; else by a link."""
    videos, left = [], EMBEDDED_BYTES
    for name, path in run.videos.items():
        size = path.stat().st_size
        here = os.path.relpath(path.resolve(), page.resolve().parent)
        fits = size <= left
        left -= size if fits else 0
        source = _data_uri(path, "video/mp4") if fits else [here]
        begin = begin_of(path)
        videos.append({"name": name, "source": source, "linked": "" if fits else here, "begin": begin})
    return videos


def _data_uri(path: Path, kind: str) -> Iterator[str]:
    """A file as an address, piece by piece: no video is held whole."""
    yield f"data:{kind};base64,"
    with open(path, "rb") as file:
        while piece := file.read(PIECE):
            yield base64.b64encode(piece).decode()


def _map_data(run: RunView) -> str:
    """What the map shows: lanes, and by track its clip and rows of t, right, up (m), thinned."""
    shown = []
    for track in run.tracks:
        ahead = track.position.shape[1] == 3 and run.frame_of_reference.startswith("left-camera")
        ground = track.position[:, [0, 2]] if ahead else track.position[:, :2]
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
    data = {"lanes": run.lanes, "tracks": shown}
    # `</script>` in a clip's name must not end the script
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
