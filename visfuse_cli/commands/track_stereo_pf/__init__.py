"""`visfuse track-stereo-pf`: the speed of vehicles that face a static stereo pair.

pairs of frames -> straight pictures -> fronts followed by particles and aligned -> newcomers -> settled tracks -> video
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.commands.track_stereo_pf.follow import follow
from visfuse_cli.commands.track_stereo_pf.scene import VIEWS, Scene, open_views, pairs, read
from visfuse_cli.errors import InputError
from visfuse_cli.facing.annotate import UNITS, Drawn, together, together_size
from visfuse_cli.facing.conclude import conclude
from visfuse_cli.facing.front import Target
from visfuse_cli.facing.output import track_record
from visfuse_cli.facing.rival import follow_triangulated
from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video import describe
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.pipeline import Run, opened
from visfuse_cli.records import Array, RunRequest, RunResult

WAY_POINTS = 40  # that a path is drawn with

__all__ = ["StereoConfig", "run", "text"]


@dataclass(slots=True)
class _Results:
    begun: list[tuple[int, int]] = field(default_factory=list)  # first frame, id
    speeds: list[dict[str, Any]] = field(default_factory=list)
    dropped: int = 0
    clouds: dict[int, dict[int, Array]] = field(default_factory=dict)  # by id and frame, for the video
    ways: dict[int, Array] = field(default_factory=dict)


def run(request: RunRequest) -> RunResult:
    """Measure the vehicles of a scene; raises a VisfuseError before the first frame on bad input."""
    config: StereoConfig = request.config
    scene = read(request)
    inputs = [describe(path) for path in (*scene.files, *scene.views.values())]
    results = _Results()
    with opened(request, inputs, "left-camera") as (folder, run_, spool):
        sources = open_views(scene, request)
        for targets in follow(scene, sources, config, request, run_):
            with run_.stage("settle"):
                _settle(targets, scene, spool, results, run_)
        audits = run_.audited(sources)
        lengths = {name: audit.frames for name, audit in audits.items()}
        if lengths["left"] != lengths["right"]:
            run_.warn(
                f"the views have {lengths['left']} (left) and {lengths['right']} (right) frames; pairs go by time"
            )
        if not run_.counts["pairs"] and run_.stopped_by is None:
            raise InputError(f"{request.input}: no frame of one view is near in time to one of the other")
        if request.video and run_.stopped_by is None:
            _annotate(scene, folder, request, run_, spool, results)
        summary = {
            "vehicles": len(results.begun),
            "speeds": results.speeds,
            "dropped": results.dropped,
            "pairs": run_.counts["pairs"],
            "units": config.display.units,
            "out": str(folder),
        }
        run_.write_json(folder, request, inputs, audits, {"summary": summary})
    return RunResult(request.out, summary, run_.warnings, run_.stopped_by, run_.stages)


def _settle(targets: list[Target], scene: Scene, spool: TrackSpool, results: _Results, run_: Run) -> None:
    for target in targets:
        alone = target.config.filter.kind == "triangulation"
        settled = follow_triangulated(target) if alone else conclude(target)
        if settled is None:
            results.dropped += 1
            run_.count("dropped")
            continue
        record = track_record(settled, scene.rig, target.config.latency)
        results.clouds[settled.id] = target.clouds
        ends = [settled.way.nearest(place) for place in settled.belief.mean[[0, -1], :3]]
        results.ways[settled.id] = settled.way.frame(np.linspace(ends[0], ends[1], WAY_POINTS))[0]
        spool.add(record)
        results.begun.append((settled.frame[0], settled.id))
        results.speeds.append(
            {"id": settled.id} | {k: record["summary"][k] for k in ("speed", "speed_ci95", "distance")}
        )
        run_.count("vehicles")


def _annotate(scene: Scene, folder: Path, request: RunRequest, run_: Run, spool: TrackSpool, results: _Results) -> None:
    """Write both views side by side, from a second decode."""
    sources = open_views(scene, request)
    drawn = [
        Drawn(spool.read(k), scene.rig, request.config.display.units, results.clouds[k], results.ways[k])
        for _, k in sorted(results.begun)
    ]
    size = together_size(*scene.size)
    with (
        VideoWriter(folder / "annotated.mp4", *size, sources["left"].nominal_rate) as writer,
        run_.background(writer) as out,
    ):
        for pair in pairs(sources, run_):
            pictures = {name: pair.frames[name].image for name in VIEWS}
            for each in drawn:
                each.draw(pictures, pair.frames["left"].index)
            out.write(together(pictures["left"], pictures["right"], pair.t), pair.t)


def text(result: RunResult) -> str:
    """The summary for people."""
    summary = result.summary
    factor, units = UNITS[summary["units"]], summary["units"]
    lines = [f"{'vehicles':<12} {summary['vehicles']}"]
    for each in summary["speeds"]:
        low, high = (end * factor for end in each["speed_ci95"])
        speed = f"{each['speed'] * factor:.2f} {units} [{low:.2f}, {high:.2f}]"
        lines.append(f"  {each['id']:<10} {speed} over {each['distance']:.1f} m")
    lines.append(f"{'pairs':<12} {summary['pairs']}")
    lines.append(f"{'results':<12} {summary['out']}")
    return "\n".join(lines)
