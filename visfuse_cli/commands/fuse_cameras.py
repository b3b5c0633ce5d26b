"""`visfuse fuse-cameras`: several fixed cameras, one calibration, and the people before them in 3D.

sets of frames -> sightings of everybody followed -> closed-loop fusion -> newcomers -> settled tracks -> video and map
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import tee
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.images import write_image
from visfuse_cli.files.multi_calibration import read_views
from visfuse_cli.files.multi_scene import Footage, find_footage
from visfuse_cli.files.run_json import write_run_json
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.scene import check_scene
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video import VideoSource, describe
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.fusing.annotate import Drawn, GroundPlan, active, draw_view, mosaic, mosaic_size
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
    extent: Array = field(default_factory=lambda: np.zeros((0, 2)))  # corners of where people were, m
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
        write_image(folder / "map.png", _plan(scene, results).whole(_drawn(scene, config, spool, results)))
        if request.video and run_.stopped_by is None and all(each.video for each in scene.footage):
            _annotate(scene, offsets, folder, request, run_, spool, results)
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
    for instant in run_.synchronise(sources, _tolerance(sources), offsets):
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
        places = np.concatenate([results.extent, path.belief.mean[:, :2]])
        results.extent = np.stack([places.min(axis=0), places.max(axis=0)])
        run_.count("people")


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
        instants, again = tee(run_.synchronise(sources, _tolerance(sources), offsets))
        frames = (instant.frames[scene.names[0]].index for instant in again)
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
    return 0.55 / min(source.nominal_rate for source in sources.values())


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
