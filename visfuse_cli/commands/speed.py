"""`visfuse speed`: one fixed camera, a ground homography, and the speed of everything that moves.

frames -> steady -> background -> regions -> tracker (predict, measure, update) -> conclude -> judge -> tables and video
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from visfuse_cli.config import Section
from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files import detections as detection_files
from visfuse_cli.files import homography as homography_files
from visfuse_cli.files.atomic import replacing
from visfuse_cli.files.folders import paths_of
from visfuse_cli.files.lanes_file import read_lanes, write_lanes
from visfuse_cli.files.run_json import write_run_json
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.spool import TrackSpool, write_table
from visfuse_cli.files.video import VideoSource, describe, is_clip_folder, list_clips, open_source
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.files.wall_clock import began, check_pattern, known_zone
from visfuse_cli.maths.cameras import ground_camera, raised
from visfuse_cli.maths.polygons import Polygon
from visfuse_cli.pipeline import Run, helper, with_next
from visfuse_cli.records import Array, Frame, GroundCamera, GroundMap, Image, RunRequest, RunResult, TimeAudit
from visfuse_cli.tracking.annotate import annotate
from visfuse_cli.tracking.camera_watch import CameraWatch
from visfuse_cli.tracking.foreground import Detections, Detector, HandOver, MovingRegions
from visfuse_cli.tracking.ground import GroundTracker
from visfuse_cli.tracking.headlights import Headlights
from visfuse_cli.tracking.ledger import Ledger, Recording, utc
from visfuse_cli.tracking.options import SpeedOptions
from visfuse_cli.tracking.output import COLUMNS
from visfuse_cli.tracking.privacy import Strangers
from visfuse_cli.tracking.summary import summarised, text
from visfuse_cli.tracking.targets import Abandoned, Track
from visfuse_cli.tracking.zones import Region
from visfuse_cli.vision.empty import empty_picture
from visfuse_cli.vision.steady import at_rest

__all__ = ["SpeedConfig", "run", "text"]

WARMUP_PICTURES = 31
LEAST_SIDE = 8  # px


class VideoSettings(Section):
    """Where times come from when the footage carries none."""

    fps: float | None = Field(None, gt=0, le=10000, description="frames/s of an image folder without timestamps.csv")


class ClockSettings(Section):
    """When recordings began, by the clock on the wall."""

    pattern: str | None = Field(
        None, description="strptime pattern of a clip's whole name without its ending, like cam1_%Y%m%d-%H%M%S"
    )
    zone: str = Field("UTC", description="IANA time zone of the times in names, like Europe/Vienna")

    @field_validator("pattern")
    @classmethod
    def _tells_the_hour(cls, pattern: str | None) -> str | None:
        if pattern is not None:
            check_pattern(pattern)
        return pattern

    @field_validator("zone")
    @classmethod
    def _known(cls, zone: str) -> str:
        known_zone(zone)
        return zone


class SpeedConfig(SpeedOptions):
    """Configuration of `visfuse speed`."""

    video: VideoSettings = VideoSettings()
    clock: ClockSettings = ClockSettings()


@dataclass(slots=True)
class _Results:
    """What a run has found so far, by clip where it is a clip's own."""

    ledger: Ledger
    audits: dict[str, TimeAudit] = field(default_factory=dict)
    began: dict[str, datetime | None] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)  # about times of day
    watches: dict[str, CameraWatch] = field(default_factory=dict)
    suns: dict[str, dict[str, Any] | None] = field(default_factory=dict)
    strangers: dict[str, Strangers] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Clip:
    """One recording and everything its frames need."""

    name: str
    source: VideoSource
    camera: GroundCamera
    config: SpeedConfig
    boxes: dict[int, Array] | None


def run(request: RunRequest) -> RunResult:
    """Measure every recording of `request.input`; raises a VisfuseError before the first frame on bad input."""
    config: SpeedConfig = request.config
    ground = _ground_map(request.options["homography"])
    several = is_clip_folder(request.input)
    clips = list_clips(request.input) if several else [request.input]
    boxes = _boxes(request.options.get("detections"), several)
    known = config.lanes or (read_lanes(config.lanes_file) if config.lanes_file is not None else None)
    given = (request.options["homography"], request.options.get("detections"), known and config.lanes_file)
    inputs = [describe(path) for path in (*clips, *given) if path]
    results = _Results(Ledger(config))
    for path in clips:
        with _open(path, request) as source:
            _check_size(source, ground, path)
            _camera(ground, source, config)
            moment, doubt = began(path, config.clock.pattern, config.clock.zone, source.creation_time)
            results.began[path.name] = moment
            results.doubts += [doubt] if doubt else []
    with (
        RunFolder(request.out, request.overwrite, inputs=[request.input, *paths_of(inputs)]) as folder,
        Run(request.progress) as run_,
        TrackSpool(folder, "speed", request.seed, "ground") as spool,
    ):
        for doubt in results.doubts:
            run_.warn(doubt)
        next_id = 1
        for path in clips:
            with _open(path, request) as source:
                camera = _camera(ground, source, config)
                clip = _Clip(path.name, source, camera, config, boxes)
                next_id = _track(clip, run_, spool, results, next_id, path.name if several else None)
            if run_.stopped_by is not None:
                break
        ledger = results.ledger
        lanes = known or _found_lanes(ledger, camera, config, run_)
        ledger.give_lanes(lanes)
        if lanes:
            write_lanes(folder / "lanes.yaml", lanes)
        write_table(folder / "speeds.csv", COLUMNS, ledger.rows)
        write_table(folder / "rejected.csv", (*COLUMNS, "reason"), ledger.rejected)
        if request.video and run_.stopped_by is None:
            for path in clips:
                if path.name in ledger.drawn:
                    name = f"annotated-{path.stem}.mp4" if several else "annotated.mp4"
                    _annotate(path, folder / name, ground, request, run_, spool, results, lanes)
        if not config.privacy.blur:  # the picture shows a frame of the footage
            _keep_calibration_picture(request.options["homography"], folder)
        summary = summarised(
            ledger.speeds, len(ledger.rejected), config.display.units, run_.counts["frames"], results.audits, folder
        )
        write_run_json(
            folder / "run.json",
            command="speed",
            argv=request.argv,
            config=config.model_dump(mode="json"),
            inputs=inputs,
            seed=request.seed,
            started=run_.started,
            audits=results.audits,
            warnings=run_.warnings,
            counts=run_.counts,
            stages=run_.stages,
            stopped_by=run_.stopped_by,
            extra={
                "summary": summary,
                "began_utc": {name: utc(moment, 0.0) or None for name, moment in results.began.items()},
                "camera": {name: watch.report() for name, watch in results.watches.items()},
                "crs": None if ground.reference is None else asdict(ground.reference),
                "sun": results.suns,
                "lanes": lanes,
                "annotated_by": "a second decode of the footage" if request.video else None,
            },
        )
    return RunResult(request.out, summary, run_.warnings, run_.stopped_by, run_.stages)


def _ground_map(path: Path) -> GroundMap:
    ground = homography_files.read(path)
    if ground.input != "pixel":
        raise InputError(f"{path}: maps gaze angles; speed needs a homography from image points or lines")
    return ground


def _boxes(path: Path | None, several: bool) -> dict[int, Array] | None:
    if path is None:
        return None
    if several:
        raise InputError(f"{path}: detections belong to one recording; give speed one clip, not a folder of clips")
    return detection_files.read_mot(path)


def _camera(ground: GroundMap, source: VideoSource, config: SpeedConfig) -> GroundCamera:
    """The camera over the plane that targets stand on."""
    size = source.width, source.height
    camera = ground_camera(replace(ground, image_size=size), size)
    try:
        return raised(camera, config.target.height)
    except ValueError as problem:
        raise UsageError(f"target.height: {problem}") from problem


def _open(path: Path, request: RunRequest) -> VideoSource:
    return open_source(path, fps=request.config.video.fps, start=request.start, end=request.end)


def _check_size(source: VideoSource, ground: GroundMap, path: Path) -> None:
    size = (source.width, source.height)
    if min(size) < LEAST_SIDE:
        raise InputError(
            f"{path}: is {size[0]}x{size[1]}; pictures of {LEAST_SIDE}x{LEAST_SIDE} and more are measured in"
        )
    if ground.image_size is not None and size != ground.image_size:
        wide, high = ground.image_size
        raise InputError(
            f"{path}: is {size[0]}x{size[1]}, but the homography was made for {wide}x{high}; calibrate at this size"
        )


def _track(clip: _Clip, run_: Run, spool: TrackSpool, results: _Results, first_id: int, label: str | None) -> int:
    """Follow everything in one clip; returns the next free id."""
    tracker = GroundTracker(clip.camera, clip.config, first_id)
    results.ledger.drawn[clip.name] = []
    strangers = results.strangers[clip.name] = Strangers(clip.camera)
    with helper() as hand_over:
        with run_.stage("warm up"):
            empty = empty_picture(at_rest(_sampled(clip.source, clip.config.background.warmup_s)))
            watch = results.watches[clip.name] = CameraWatch(empty)
            look, lamps = _detector(clip, empty, hand_over), Headlights(empty, clip.camera)
        of = Recording(clip.name, label, clip.camera, results.began[clip.name], watch.image_from_rest)
        for frame, following in with_next(_steadied(clip.source, watch, run_)):
            tracker.predict(frame.t)
            with run_.stage("detect"):
                evidence = look.evidence(frame, tracker.expected())
            if following is not None:
                look.foresee(following)
            with run_.stage("track"):
                ended = tracker.update(frame.index, evidence)
                if clip.config.privacy.blur:
                    strangers.add(frame.index, tracker.unexplained)
                lamps.look(frame, tracker.tracks, tracker.headings())
            with run_.stage("conclude"):
                _settle(*ended, of, tracker, lamps, run_, spool, results.ledger)
            with run_.stage("learn"):
                look.learn(frame, tracker)
        _settle(*tracker.finish(), of, tracker, lamps, run_, spool, results.ledger)
    results.suns[clip.name] = look.report()
    audit = results.audits[clip.name] = clip.source.audit()
    for warning in (*audit.warnings, *watch.warnings(clip.name)):
        run_.warn(warning)
    return tracker.next_id


def _steadied(source: VideoSource, watch: CameraWatch, run_: Run) -> Iterator[Frame]:
    """The frames in which the scene is recognised, as the camera at rest sees them."""
    for frame in run_.prepared(source, watch.steadied):
        run_.count("frames")
        if frame is not None:
            yield frame


def _detector(clip: _Clip, empty: Image, hand_over: HandOver) -> Detector:
    config = clip.config
    region = Region(np.array(config.region)) if config.region else None
    if clip.boxes is not None:
        return Detections(clip.camera, clip.boxes, region)
    return MovingRegions(
        clip.camera, config.background, config.regions, config.target.smallest, empty, region, hand_over
    )


def _sampled(source: VideoSource, warmup_s: float) -> Iterator[Any]:
    """Pictures spread over the first `warmup_s` seconds; the first picture at least."""
    span = warmup_s * source.nominal_rate
    if source.frame_count is not None:
        span = min(span, source.frame_count)
    step = max(1, round(span / WARMUP_PICTURES))
    first: float | None = None
    for number, frame in enumerate(source.frames()):
        first = frame.t if first is None else first
        if number and frame.t - first >= warmup_s:
            return
        if number % step == 0:
            yield frame.image


def _settle(
    tracks: list[Track],
    abandoned: list[Abandoned],
    of: Recording,
    tracker: GroundTracker,
    lamps: Headlights,
    run_: Run,
    spool: TrackSpool,
    ledger: Ledger,
) -> None:
    """Turn what ended into records and table rows."""
    for track in tracks:
        record = ledger.take(track, of, tracker.dynamics, lamps.only_light(track.id))
        if record is not None:
            spool.add(record)
            run_.count("rejected" if record["summary"]["rejected"] else "vehicles")
    for candidate in abandoned:
        ledger.give_up(candidate, of)
        run_.count("regions that never became a track")


def _found_lanes(ledger: Ledger, camera: GroundCamera, config: SpeedConfig, run_: Run) -> tuple[Polygon, ...]:
    """The lanes that this run finds, kept in the file that is still missing."""
    lanes = ledger.found_lanes(camera)
    if config.lanes_file is not None and lanes:
        write_lanes(config.lanes_file, lanes)
    elif config.lanes_file is not None:
        run_.warn(f"{config.lanes_file}: not written: {len(ledger.rows)} vehicles tell of no lane")
    return lanes


def _annotate(
    path: Path,
    out: Path,
    ground: GroundMap,
    request: RunRequest,
    run_: Run,
    spool: TrackSpool,
    results: _Results,
    lanes: tuple[Polygon, ...],
) -> None:
    """Write the annotated video of one clip from a second decode; a stop request ends it early and readable."""
    config: SpeedConfig = request.config
    places = {f"lane {number}": lane for number, lane in enumerate(lanes, start=1)} | {"region": config.region}
    with _open(path, request) as source:
        camera = _camera(ground, source, request.config)
        records = (spool.read(identity) for _, identity in sorted(results.ledger.drawn[path.name]))
        watch, strangers = results.watches[path.name], results.strangers[path.name]
        with (
            VideoWriter(out, source.width, source.height, source.nominal_rate) as video,
            run_.background(video) as sink,
        ):
            for frame in annotate(run_.frames(source), records, camera, config, watch, strangers, places):
                sink.write(frame.image, frame.t)


def _keep_calibration_picture(homography: Path, folder: Path) -> None:
    """Lay the picture that the calibration drew beside its homography, if it did, with the results."""
    picture = homography.with_suffix(".png")
    if picture.is_file():
        with replacing(folder / "calibration.png") as file:
            file.write(picture.read_bytes())
