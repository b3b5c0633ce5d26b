"""`visfuse fuse-cameras`: several fixed cameras, one calibration, and the people before them in 3D.

sets of frames -> sightings of everybody followed -> closed-loop fusion -> newcomers -> settled tracks -> video and map
"""

from __future__ import annotations

from visfuse_cli.commands.fuse_cameras.follow import estimated_offsets, eyes_of, follow
from visfuse_cli.commands.fuse_cameras.results import Results, settle, summary_of
from visfuse_cli.commands.fuse_cameras.scene import given_offsets, interval, open_footage, read, shorter
from visfuse_cli.commands.fuse_cameras.video import annotate, drawn_tracks, plan_of
from visfuse_cli.files.images import write_image
from visfuse_cli.files.video import describe
from visfuse_cli.fusing.audit import complaints
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.tracker import Tracker
from visfuse_cli.pipeline import opened
from visfuse_cli.records import RunRequest, RunResult

__all__ = ["FuseConfig", "run", "text"]


def run(request: RunRequest) -> RunResult:
    """Follow everybody in a scene; raises a VisfuseError before the first frame on bad input."""
    config: FuseConfig = request.config
    scene = read(request)
    inputs = [describe(path) for path in (*scene.files, *(path for each in scene.footage for path in each.files))]
    offsets = given_offsets(config, scene)
    results = Results()
    with opened(request, inputs, "world") as (folder, run_, spool):
        sources = open_footage(scene, request)
        with run_.stage("warm up"):
            eyes = eyes_of(scene, sources, config)
        if request.options["estimate_offsets"]:
            offsets = estimated_offsets(scene, eyes, offsets, request, run_)
        tracker = Tracker(eyes.P, config)
        for ended in follow(scene, sources, eyes, tracker, offsets, run_):
            run_.count("sets of frames")
            with run_.stage("settle"):
                settle(ended, eyes, scene, config, run_, spool, results)
        with run_.stage("settle"):
            settle(tracker.finish(), eyes, scene, config, run_, spool, results)
        results.findings = tracker.audit.findings(eyes.zoom)
        for warning in complaints(scene.names, results.findings, interval(sources)):
            run_.warn(warning)
        audits = run_.audited(sources)
        for warning in shorter(audits):
            run_.warn(warning)
        write_image(folder / "map.png", plan_of(scene, results).whole(drawn_tracks(scene, config, spool, results)))
        if request.video and run_.stopped_by is None and all(each.video for each in scene.footage):
            annotate(scene, offsets, folder, request, run_, spool, results)
        summary = summary_of(scene, offsets, run_, results, folder)
        run_.write_json(folder, request, inputs, audits, {"summary": summary})
    return RunResult(request.out, summary, run_.warnings, run_.stopped_by, run_.stages)


def text(result: RunResult) -> str:
    """The summary for people."""
    summary = result.summary
    lines = [f"{'people':<12} {summary['people']}"]
    lines.append(f"{'cameras':<12} {', '.join(summary['cameras'])}")
    lines.append(f"{'sets':<12} {summary['sets_of_frames']}")
    if any(summary["offsets"].values()):
        lines.append(f"{'offsets':<12} " + ", ".join(f"{name} {s:+.3f} s" for name, s in summary["offsets"].items()))
    for name, each in summary["per_camera"].items():
        error = "-" if each["reprojection_px"] is None else f"{each['reprojection_px']:.1f} px"
        lines.append(f"  {name:<10} {each['sightings']:>7} sightings, {each['share']:>4.0%} of the fix, {error}")
    lines.append(f"{'results':<12} {summary['out']}")
    return "\n".join(lines)
