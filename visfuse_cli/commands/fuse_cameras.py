"""`visfuse fuse-cameras`: several fixed cameras, one calibration, and the people before them in 3D.

sets of frames -> sightings of everybody followed -> closed-loop fusion -> newcomers -> settled tracks -> video and map
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import tee
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.folders import paths_of
from visfuse_cli.files.images import write_image
from visfuse_cli.files.multi_calibration import read_views
from visfuse_cli.files.multi_scene import Footage, find_footage
from visfuse_cli.files.run_json import write_run_json
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.scene import check_scene
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video import VideoSource, describe
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.fusing import clocks
from visfuse_cli.fusing.annotate import Drawn, GroundPlan, active, draw_view, mosaic, mosaic_size
from visfuse_cli.fusing.audit import Finding, complaints
from visfuse_cli.fusing.conclude import Path as Settled
from visfuse_cli.fusing.conclude import conclude
from visfuse_cli.fusing.eyes import BoxEyes, Eyes, PictureEyes
from visfuse_cli.fusing.output import track_record
from visfuse_cli.fusing.person import Person
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.tracker import Tracker
from visfuse_cli.maths import multiview
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, RunRequest, RunResult, TimeAudit, View

__all__ = ["FuseConfig", "run", "text"]

CLOCK_S = 60.0  # s of footage from which clocks are estimated
CLOCK_STEP_S = 0.2  # s between the frames that the first, coarse round looks at
CLOCK_ROUNDS = 6
CLOCK_DONE_S = 0.004


@dataclass(slots=True)
class _Scene:
    """Everything a run needs to know of its scene; views are in the ground's frame, x_ground = R x_world + t."""

    views: list[View]
    footage: list[Footage]
    files: list[Path]
    R: Array
    t: Array
    P: Array

    @property
    def names(self) -> list[str]:
        return [view.name for view in self.views]


@dataclass(slots=True)
class _Results:
    """What a run has found so far."""

    begun: list[tuple[int, int]] = field(default_factory=list)  # first frame, id
    extent: Array = field(default_factory=lambda: np.zeros((0, 2)))  # corners of where people were, m
    rejected: dict[str, int] = field(default_factory=dict)
    sightings: Array = field(default_factory=lambda: np.zeros(0))  # by camera
    share: Array = field(default_factory=lambda: np.zeros(0))  # of what was measured, summed over sets and people
    square: Array = field(default_factory=lambda: np.zeros(0))  # px^2, of the reprojection, summed
    findings: list[Finding] = field(default_factory=list)


def run(request: RunRequest) -> RunResult:
    """Follow everybody in a scene; raises a VisfuseError before the first frame on bad input."""
    config: FuseConfig = request.config
    scene = _read(request)
    inputs = [describe(path) for path in (*scene.files, *(path for each in scene.footage for path in each.files))]
    offsets = _offsets(config, scene)
    results = _Results()
    with (
        RunFolder(request.out, request.overwrite, inputs=[request.input, *paths_of(inputs)]) as folder,
        Run(request.progress) as run_,
        TrackSpool(folder, "fuse-cameras", request.seed, "world") as spool,
    ):
        if request.options["estimate_offsets"]:
            offsets = _estimated(scene, offsets, request, run_)
        sources = _open(scene, request)
        with run_.stage("warm up"):
            eyes = _eyes(scene, sources, config)
        tracker = Tracker(eyes.P, config)
        for ended in _follow(scene, sources, eyes, tracker, offsets, run_):
            run_.count("sets of frames")
            with run_.stage("settle"):
                _settle(ended, eyes, scene, config, run_, spool, results)
        with run_.stage("settle"):
            _settle(tracker.finish(), eyes, scene, config, run_, spool, results)
        results.findings = tracker.audit.findings(eyes.zoom)
        for warning in complaints(scene.names, results.findings, _interval(sources)):
            run_.warn(warning)
        audits = {name: source.audit() for name, source in sources.items()}
        for audit in audits.values():
            for warning in audit.warnings:
                run_.warn(warning)
        for warning in _shorter(audits):
            run_.warn(warning)
        write_image(folder / "map.png", _plan(scene, results).whole(_drawn(scene, config, spool, results)))
        if request.video and run_.stopped_by is None and all(each.video for each in scene.footage):
            _annotate(scene, offsets, folder, request, run_, spool, results)
        summary = _summary(scene, offsets, run_, results, folder)
        write_run_json(
            folder / "run.json",
            command="fuse-cameras",
            argv=request.argv,
            config=config.model_dump(mode="json"),
            inputs=inputs,
            seed=request.seed,
            started=run_.started,
            audits=audits,
            warnings=run_.warnings,
            counts=run_.counts,
            stages=run_.stages,
            stopped_by=run_.stopped_by,
            extra={"summary": summary},
        )
    return RunResult(request.out, summary, run_.warnings, run_.stopped_by, run_.stages)


def _read(request: RunRequest) -> _Scene:
    """The scene's cameras and footage, all of it checked."""
    config: FuseConfig = request.config
    check_scene(request.input)
    views, files = read_views(request.input)
    R, t = multiview.ground_from_world(np.array(config.world.ground))
    moved = [multiview.moved_view(view, R, t) for view in views]
    low = [view for view in moved if view.centre[2] <= 0.05]
    if low:
        raise InputError(
            f"{files[0]}: camera '{low[0].name}' lies {-low[0].centre[2]:.2f} m below the ground; "
            "set world.ground [a, b, c, d] so that a x + b y + c z + d is positive where the cameras are"
        )
    footage = find_footage(request.input, moved, config.video.fps)
    scene = _Scene(moved, footage, files, R, t, np.stack([multiview.projection(view) for view in moved]))
    for source in _open(scene, request).values():
        source.__exit__(None, None, None)
    return scene


def _open(scene: _Scene, request: RunRequest) -> dict[str, VideoSource]:
    fps = request.config.video.fps
    return {each.view.name: each.open(fps, request.start, request.end) for each in scene.footage}


def _offsets(config: FuseConfig, scene: _Scene) -> dict[str, float]:
    """Seconds by camera, all of them; raises UsageError for a camera that is not there."""
    unknown = [name for name in config.fusion.offsets if name not in scene.names]
    if unknown:
        raise UsageError(f"fusion.offsets: no camera '{unknown[0]}'; the scene has {', '.join(scene.names)}")
    return {name: config.fusion.offsets.get(name, 0.0) for name in scene.names}


def _follow(
    scene: _Scene,
    sources: dict[str, VideoSource],
    eyes: Eyes,
    tracker: Tracker,
    offsets: dict[str, float],
    run_: Run,
) -> Iterator[list[Person]]:
    """Follow everybody through the footage; yields, set by set, whom nobody follows any more."""
    for instant in run_.synchronise(sources, _tolerance(sources), offsets, _spacing(sources)):
        with run_.stage("detect"):
            eyes.detect(instant)
        with run_.stage("fuse"):
            tracker.predict(instant.t)
        with run_.stage("look"):
            sightings = eyes.look(tracker)
        with run_.stage("fuse"):
            tracker.update(instant.index, sightings)
            inside, clear = eyes.visible(tracker.beliefs)
            tracker.miss(clear & eyes.open, sightings)
            tracker.watch(clear & eyes.open)
            ended = tracker.end(instant.t, np.count_nonzero(inside, axis=1))
        with run_.stage("newcomers"):
            tracker.begin(instant.index, instant.t, eyes.newcomers(tracker))
        with run_.stage("learn"):
            eyes.learn(instant.t, tracker)
        yield ended


def _estimated(scene: _Scene, offsets: dict[str, float], request: RunRequest, run_: Run) -> dict[str, float]:
    """The clocks' offsets (s by camera): places that cameras see alone agree roughly, tracks of all of them exactly."""
    config: FuseConfig = request.config
    begin = request.start or 0.0
    part = replace(request, end=min(begin + CLOCK_S, request.end or np.inf))
    sources = _open(scene, part)
    eyes = _eyes(scene, sources, config)
    walks = [clocks.Walks() for _ in scene.names]
    for camera, source in enumerate(sources.values()):
        due = -np.inf
        for frame in run_.frames(source):
            if frame.t >= due:
                due = frame.t + CLOCK_STEP_S
                walks[camera].add(frame.t, eyes.alone(camera, frame))
    given = np.array([offsets[name] for name in scene.names])
    found = clocks.coarse(walks, given, config.fusion.largest_offset)
    if found is None:
        run_.warn(
            "--estimate-offsets: too few people walk where cameras see them alone; fusion.offsets is left as it is"
        )
        return offsets
    for _ in range(CLOCK_ROUNDS):
        sources = _open(scene, part)
        tracker = Tracker(eyes.P, config)
        eyes = _eyes(scene, sources, config)
        for _ in _follow(scene, sources, eyes, tracker, dict(zip(scene.names, found.tolist(), strict=True)), run_):
            pass
        better = clocks.corrected(found, tracker.audit.findings(eyes.zoom))
        moved, found = float(np.abs(better - found).max()), better
        if moved < CLOCK_DONE_S:
            break
    return {name: round(float(seconds), 4) for name, seconds in zip(scene.names, found, strict=True)}


def _eyes(scene: _Scene, sources: dict[str, VideoSource], config: FuseConfig) -> Eyes:
    """What looks at each set of frames: boxes from outside where there are any, else the pictures."""
    if scene.footage[0].boxes is not None:
        return BoxEyes(scene.views, [each.boxes or {} for each in scene.footage], config)
    return PictureEyes(scene.views, list(sources.values()), config)


def _settle(
    ended: list[Person], eyes: Eyes, scene: _Scene, config: FuseConfig, run_: Run, spool: TrackSpool, results: _Results
) -> None:
    """Turn whom nobody follows any more into records."""
    for person in ended:
        path: Settled | None = conclude(person, eyes.P, config)
        if path is None:
            reason = person.ended_by if not person.confirmed else "too short"
            results.rejected[reason] = results.rejected.get(reason, 0) + 1
            run_.count("rejected")
            continue
        path = replace(path, residual=path.residual * eyes.zoom[:, None])
        spool.add(track_record(path, scene.names, scene.R, scene.t))
        results.begun.append((int(path.frame[path.told][0]), path.id))
        _contribute(path, results)
        places = np.concatenate([results.extent, path.belief.mean[:, :2]])
        results.extent = np.stack([places.min(axis=0), places.max(axis=0)])
        run_.count("people")


def _contribute(path: Settled, results: _Results) -> None:
    """Count what each camera added to a path."""
    seen, square = path.seen.sum(axis=0), np.nansum(np.sum(path.residual**2, axis=2), axis=0)
    if not len(results.sightings):
        results.sightings, results.share, results.square = 0.0 * seen, 0.0 * square, 0.0 * square
    results.sightings = results.sightings + seen
    results.share = results.share + path.weight.sum(axis=0)
    results.square = results.square + square


def _plan(scene: _Scene, results: _Results) -> GroundPlan:
    return GroundPlan(scene.views, results.extent)


def _drawn(scene: _Scene, config: FuseConfig, spool: TrackSpool, results: _Results) -> Iterator[Drawn]:
    """The settled tracks in the order of their first frames."""
    centroid = config.fusion.point == "centroid"
    for _, identity in sorted(results.begun):
        yield Drawn(spool.read(identity), scene.R, scene.t, config.display.units, centroid)


def _annotate(
    scene: _Scene,
    offsets: dict[str, float],
    folder: Path,
    request: RunRequest,
    run_: Run,
    spool: TrackSpool,
    results: _Results,
) -> None:
    """Write each camera's annotated video and the mosaic from a second decode."""
    sources = _open(scene, request)
    plan = _plan(scene, results)
    with ExitStack() as stack:
        rate = next(iter(sources.values())).nominal_rate
        sinks = {}
        for name, source in sources.items():
            writer = VideoWriter(folder / f"annotated-{name}.mp4", source.width, source.height, source.nominal_rate)
            sinks[name] = stack.enter_context(run_.background(stack.enter_context(writer)))
        writer = VideoWriter(folder / "mosaic.mp4", *mosaic_size(scene.views), rate)
        whole = stack.enter_context(run_.background(stack.enter_context(writer)))
        instants, again = tee(run_.synchronise(sources, _tolerance(sources), offsets, _spacing(sources)))
        frames = (instant.index for instant in again)
        drawn = _drawn(scene, request.config, spool, results)
        for people, instant in zip(active(drawn, frames), instants, strict=True):
            for view in scene.views:
                frame = instant.frames.get(view.name)
                if frame is not None:
                    draw_view(frame.image, view, people, instant.t)
                    sinks[view.name].write(frame.image, frame.t)
            pictures = {name: frame.image for name, frame in instant.frames.items()}
            whole.write(mosaic(scene.views, pictures, plan.now(people)), instant.t)


def _tolerance(sources: dict[str, VideoSource]) -> float:
    """How far (s) a frame may be from the instant of its set: half of the longest interval, and a little."""
    return 0.55 * _interval(sources)


def _spacing(sources: dict[str, VideoSource]) -> float:
    """The time (s) from one set to the next where the first camera has nothing."""
    return 1 / next(iter(sources.values())).nominal_rate


def _interval(sources: dict[str, VideoSource]) -> float:
    """The longest time (s) from one frame to the next."""
    return 1 / min(source.nominal_rate for source in sources.values())


def _shorter(audits: dict[str, TimeAudit]) -> list[str]:
    """Which cameras' footage ends well before the longest."""
    longest = max(audit.duration_s for audit in audits.values())
    return [
        f"camera '{name}' ends after {audit.duration_s:.1f} s, {longest - audit.duration_s:.1f} s before the longest"
        for name, audit in audits.items()
        if longest - audit.duration_s > max(1.0, 0.02 * longest)
    ]


def _summary(scene: _Scene, offsets: dict[str, float], run_: Run, results: _Results, folder: Path) -> dict[str, Any]:
    return {
        "per_camera": _per_camera(scene, results),
        "offsets": offsets,
        "people": len(results.begun),
        "rejected": results.rejected,
        "sets_of_frames": run_.counts["sets of frames"],
        "cameras": scene.names,
        "out": str(folder),
    }


def _per_camera(scene: _Scene, results: _Results) -> dict[str, dict[str, Any]]:
    """What each camera added, and how it fits the others."""
    total = float(results.share.sum()) if len(results.share) else 0.0
    told: dict[str, dict[str, Any]] = {}
    for c, (name, found) in enumerate(zip(scene.names, results.findings, strict=True)):
        n = float(results.sightings[c]) if len(results.sightings) else 0.0
        told[name] = {
            "sightings": int(n),
            "share": float(results.share[c]) / total if total else 0.0,
            "reprojection_px": float(np.sqrt(results.square[c] / n)) if n else None,
            "shift_px": found.shift.tolist(),
            "late_s": found.late,
            "unused": found.unused,
        }
    return told


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
