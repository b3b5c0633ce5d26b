"""`visfuse track-imm`: a moving stereo camera follows what moves, or a pan-tilt head does on the ground.

sensors.csv tells which: gaze angles are a pan-tilt head's, all else is a stereo head's.
"""

from __future__ import annotations

from typing import Any

from visfuse_cli.commands.track_imm.pan_tilt import PanTiltRun
from visfuse_cli.commands.track_imm.scene import open_views
from visfuse_cli.commands.track_imm.stereo import StereoRun
from visfuse_cli.errors import InputError
from visfuse_cli.files.scene import check_scene, file
from visfuse_cli.files.sensors import read_sensors
from visfuse_cli.files.video import VideoSource, describe
from visfuse_cli.moving.annotate import UNITS
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.pipeline import Run, opened
from visfuse_cli.records import RunRequest, RunResult

__all__ = ["ImmConfig", "run", "text"]

KEPT = ("speed", "distance", "n_frames", "prediction_rms_2d", "prediction_rms_3d")  # of each track, in the summary


def run(request: RunRequest) -> RunResult:
    """Follow what moves in a scene; raises a VisfuseError before the first frame on bad input."""
    head = _head(request)
    inputs = [describe(path) for path in (*head.files, *head.views.values())]
    with opened(request, inputs, head.frame_of_reference) as (folder, run_, spool):
        for warning in head.sensors.warnings:
            run_.warn(warning)
        sources = open_views(head.views, request)
        tracks: list[dict[str, Any]] = []
        for record in head.follow(sources, run_):
            if record is None:
                run_.count("dropped")
                continue
            spool.add(record)
            tracks.append({"id": record["id"]} | {k: v for k, v in record["summary"].items() if k in KEPT})
            run_.count("targets")
        tracks.sort(key=lambda track: track["id"])
        audits = _audit(head, sources, run_)
        if request.video and run_.stopped_by is None:
            records = (spool.read(track["id"]) for track in tracks)
            head.draw(open_views(head.views, request), records, folder / "annotated.mp4", run_)
        brief, own = head.extra()
        summary = {"targets": len(tracks), "tracks": tracks, "frames": run_.counts["frames"]} | brief
        summary |= {"units": request.config.display.units, "out": str(folder)}
        run_.write_json(folder, request, inputs, audits, {"summary": summary} | own)
    return RunResult(request.out, summary, run_.warnings, run_.stopped_by, run_.stages)


def _head(request: RunRequest) -> StereoRun | PanTiltRun:
    """The kind of head that the scene's sensors belong to, its scene read and checked."""
    check_scene(request.input)
    path = file(request.input, ("sensors.csv",), "sensors of the camera's motion")
    sensors = read_sensors(path)
    if sensors.form == "gaze":
        return PanTiltRun(request, path, sensors)
    if request.options.get("homography") is not None:
        raise InputError(f"{path}: holds {sensors.form}; with --homography, a pan-tilt head's t,elevation,vergence")
    return StereoRun(request, path, sensors)


def _audit(head: StereoRun | PanTiltRun, sources: dict[str, VideoSource], run_: Run) -> dict[str, Any]:
    audits = run_.audited(sources)
    doubt = head.audited({name: audit.frames for name, audit in audits.items()})
    if doubt is not None:
        run_.warn(doubt)
    return audits


def text(result: RunResult) -> str:
    """The summary for people."""
    summary = result.summary
    factor, units = UNITS[summary["units"]], summary["units"]
    lines = [f"{'targets':<12} {summary['targets']}"]
    for each in summary["tracks"]:
        lines.append(
            f"  {each['id']:<10} {each['speed'] * factor:.2f} {units} over {each['distance']:.2f} m, "
            f"{each['n_frames']} frames measured"
        )
        if "prediction_rms_2d" in each:
            plane, ground = (1e3 * each[f"prediction_rms_{kind}"] for kind in ("2d", "3d"))
            lines.append(f"  {'':<10} predicted {plane:.1f} mrad off by its angles, {ground:.1f} mrad by the ground")
    if "ego_distance" in summary:
        lines.append(f"{'camera':<12} {summary['ego_distance']:.2f} m")
    lines.append(f"{'frames':<12} {summary['frames']}")
    lines.append(f"{'results':<12} {summary['out']}")
    return "\n".join(lines)
