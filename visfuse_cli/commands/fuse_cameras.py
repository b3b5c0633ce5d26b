"""`visfuse fuse-cameras`: several fixed cameras, one calibration, and the people before them in 3D.

sets of frames -> sightings of everybody followed -> closed-loop fusion -> newcomers -> settled tracks -> video and map
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.multi_calibration import read_views
from visfuse_cli.files.multi_scene import Footage, find_footage
from visfuse_cli.files.run_json import write_run_json
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.scene import check_scene
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video import VideoSource, describe
from visfuse_cli.fusing.conclude import Path as Settled
from visfuse_cli.fusing.conclude import conclude
from visfuse_cli.fusing.eyes import BoxEyes, Eyes, PictureEyes
from visfuse_cli.fusing.output import track_record
from visfuse_cli.fusing.person import Person
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.tracker import Tracker
from visfuse_cli.fusing.visibility import visibility
from visfuse_cli.maths import multiview
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, RunRequest, RunResult, View

__all__ = ["FuseConfig", "run", "text"]


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
    rejected: dict[str, int] = field(default_factory=dict)


def run(request: RunRequest) -> RunResult:
    """Follow everybody in a scene; raises a VisfuseError before the first frame on bad input."""
    config: FuseConfig = request.config
    scene = _read(request)
    inputs = [describe(path) for path in (*scene.files, *(path for each in scene.footage for path in each.files))]
    offsets = _offsets(config, scene)
    results = _Results()
    with (
        RunFolder(request.out, request.overwrite) as folder,
        Run(request.progress) as run_,
        TrackSpool(folder, "fuse-cameras", request.seed, "world") as spool,
    ):
        sources = _open(scene, request)
        _track(scene, sources, offsets, config, run_, spool, results)
        audits = {name: source.audit() for name, source in sources.items()}
        for audit in audits.values():
            for warning in audit.warnings:
                run_.warn(warning)
        summary = _summary(scene, run_, results, folder)
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


def _track(
    scene: _Scene,
    sources: dict[str, VideoSource],
    offsets: dict[str, float],
    config: FuseConfig,
    run_: Run,
    spool: TrackSpool,
    results: _Results,
) -> None:
    """Follow everybody through the whole footage."""
    with run_.stage("warm up"):
        eyes = _eyes(scene, sources, config)
    tracker = Tracker(eyes.P, config)
    tolerance = 0.55 / min(source.nominal_rate for source in sources.values())
    for instant in run_.synchronise(sources, tolerance, offsets):
        run_.count("sets of frames")
        frame = instant.frames[scene.names[0]].index
        with run_.stage("detect"):
            eyes.detect(instant)
        with run_.stage("fuse"):
            tracker.predict(instant.t)
        with run_.stage("look"):
            sightings = eyes.look(tracker)
        with run_.stage("fuse"):
            tracker.update(frame, sightings)
            inside, clear = visibility(tracker.beliefs, eyes.sizes, eyes.P, config)
            tracker.miss(clear & eyes.open, sightings)
            ended = tracker.end(instant.t, np.count_nonzero(inside, axis=1))
        with run_.stage("newcomers"):
            tracker.begin(frame, instant.t, eyes.newcomers(tracker))
        with run_.stage("learn"):
            eyes.learn(instant.t, tracker)
        with run_.stage("settle"):
            _settle(ended, eyes.P, scene, config, run_, spool, results)
    with run_.stage("settle"):
        _settle(tracker.finish(), eyes.P, scene, config, run_, spool, results)


def _eyes(scene: _Scene, sources: dict[str, VideoSource], config: FuseConfig) -> Eyes:
    """What looks at each set of frames: boxes from outside where there are any, else the pictures."""
    if scene.footage[0].boxes is not None:
        return BoxEyes(scene.views, [each.boxes or {} for each in scene.footage], config)
    return PictureEyes(scene.views, list(sources.values()), config)


def _settle(
    ended: list[Person], P: Array, scene: _Scene, config: FuseConfig, run_: Run, spool: TrackSpool, results: _Results
) -> None:
    """Turn whom nobody follows any more into records."""
    for person in ended:
        path: Settled | None = conclude(person, P, config)
        if path is None:
            reason = person.ended_by if not person.confirmed else "too short"
            results.rejected[reason] = results.rejected.get(reason, 0) + 1
            run_.count("rejected")
            continue
        spool.add(track_record(path, scene.names, scene.R, scene.t))
        results.begun.append((int(path.frame[0]), path.id))
        run_.count("people")


def _summary(scene: _Scene, run_: Run, results: _Results, folder: Path) -> dict[str, Any]:
    return {
        "people": len(results.begun),
        "rejected": results.rejected,
        "sets_of_frames": run_.counts["sets of frames"],
        "cameras": scene.names,
        "out": str(folder),
    }


def text(result: RunResult) -> str:
    """The summary for people."""
    summary = result.summary
    lines = [f"{'people':<12} {summary['people']}"]
    lines.append(f"{'cameras':<12} {', '.join(summary['cameras'])}")
    lines.append(f"{'sets':<12} {summary['sets_of_frames']}")
    lines.append(f"{'results':<12} {summary['out']}")
    return "\n".join(lines)
