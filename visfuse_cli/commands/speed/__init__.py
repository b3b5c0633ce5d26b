"""`visfuse speed`: one fixed camera, a ground homography, and the speed of everything that moves.

frames -> steady -> background -> regions -> tracker (predict, measure, update) -> conclude -> judge -> tables and video
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from visfuse_cli.commands.speed.follow import Clip, Findings, follow
from visfuse_cli.config import Section
from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files import detections as detection_files
from visfuse_cli.files import homography as homography_files
from visfuse_cli.files.atomic import replacing
from visfuse_cli.files.lanes_file import read_lanes, write_lanes
from visfuse_cli.files.spool import TrackSpool, write_table
from visfuse_cli.files.video import VideoSource, describe, is_clip_folder, list_clips, open_source
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.files.wall_clock import began, check_pattern, known_zone
from visfuse_cli.maths.cameras import ground_camera, raised
from visfuse_cli.maths.polygons import Polygon
from visfuse_cli.pipeline import Run, opened
from visfuse_cli.records import Array, GroundCamera, GroundMap, RunRequest, RunResult
from visfuse_cli.tracking.annotate import annotate
from visfuse_cli.tracking.ledger import Ledger, utc
from visfuse_cli.tracking.options import SpeedOptions
from visfuse_cli.tracking.output import COLUMNS
from visfuse_cli.tracking.summary import summarised, text

__all__ = ["SpeedConfig", "run", "text"]

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


@dataclass(frozen=True, slots=True)
class _Job:
    """What a run was asked for, read and found valid."""

    request: RunRequest
    ground: GroundMap
    clips: list[Path]
    several: bool
    boxes: dict[int, Array] | None
    lanes: tuple[Polygon, ...] | None
    inputs: list[dict[str, Any]]

    @property
    def config(self) -> SpeedConfig:
        config: SpeedConfig = self.request.config
        return config


def run(request: RunRequest) -> RunResult:
    """Measure every recording of `request.input`; raises a VisfuseError before the first frame on bad input."""
    job = _read(request)
    results = Findings(Ledger(job.config))
    for path in job.clips:
        _check(path, job, results)
    with opened(request, job.inputs, "ground") as (folder, run_, spool):
        for doubt in results.doubts:
            run_.warn(doubt)
        next_id = 1
        for path in job.clips:
            with (footage := _footage(path, request))() as source:
                camera = _camera(job.ground, source, job.config)
                clip = Clip(path.name, source, footage, camera, job.config, job.boxes)
                next_id = follow(clip, run_, spool, results, next_id, path.name if job.several else None)
            if run_.stopped_by is not None:
                break
        lanes = job.lanes or _found_lanes(results.ledger, camera, job.config, run_)
        _write_tables(results.ledger, lanes, folder)
        if request.video and run_.stopped_by is None:
            for path in job.clips:
                if path.name in results.ledger.drawn:
                    name = f"annotated-{path.stem}.mp4" if job.several else "annotated.mp4"
                    _annotate(path, folder / name, job.ground, request, run_, spool, results, lanes)
        if not job.config.privacy.blur:  # the picture shows a frame of the footage
            _keep_calibration_picture(request.options["homography"], folder)
        summary = _report(job, results, lanes, run_, folder)
    return RunResult(request.out, summary, run_.warnings, run_.stopped_by, run_.stages)


def _read(request: RunRequest) -> _Job:
    config: SpeedConfig = request.config
    ground = _ground_map(request.options["homography"])
    several = is_clip_folder(request.input)
    clips = list_clips(request.input) if several else [request.input]
    boxes = _boxes(request.options.get("detections"), several)
    known = config.lanes or (read_lanes(config.lanes_file) if config.lanes_file is not None else None)
    given = (request.options["homography"], request.options.get("detections"), known and config.lanes_file)
    inputs = [describe(path) for path in (*clips, *given) if path]
    return _Job(request, ground, clips, several, boxes, known, inputs)


def _check(path: Path, job: _Job, results: Findings) -> None:
    """Open one recording, compare it with the calibration, and note when it began."""
    clock = job.config.clock
    with _footage(path, job.request)() as source:
        _check_size(source, job.ground, path)
        _camera(job.ground, source, job.config)
        moment, doubt = began(path, clock.pattern, clock.zone, source.creation_time)
        results.began[path.name] = moment
        results.doubts += [doubt] if doubt else []


def _write_tables(ledger: Ledger, lanes: tuple[Polygon, ...], folder: Path) -> None:
    ledger.give_lanes(lanes)
    if lanes:
        write_lanes(folder / "lanes.yaml", lanes)
    write_table(folder / "speeds.csv", COLUMNS, ledger.rows)
    write_table(folder / "rejected.csv", (*COLUMNS, "reason"), ledger.rejected)


def _report(job: _Job, results: Findings, lanes: tuple[Polygon, ...], run_: Run, folder: Path) -> dict[str, Any]:
    """Write run.json; returns the summary."""
    ledger, request = results.ledger, job.request
    summary = summarised(
        ledger.speeds, len(ledger.rejected), job.config.display.units, run_.counts["frames"], results.audits, folder
    )
    run_.write_json(
        folder,
        request,
        job.inputs,
        results.audits,
        {
            "summary": summary,
            "began_utc": {name: utc(moment, 0.0) or None for name, moment in results.began.items()},
            "camera": {name: log.report() for name, log in results.cameras.items()},
            "crs": None if job.ground.reference is None else asdict(job.ground.reference),
            "sun": results.suns,
            "lanes": lanes,
            "annotated_by": "a second decode of the footage" if request.video else None,
        },
    )
    return summary


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


def _footage(path: Path, request: RunRequest) -> Callable[[], VideoSource]:
    """Opens a recording, here or in another process."""
    return partial(open_source, path, fps=request.config.video.fps, start=request.start, end=request.end)


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
    results: Findings,
    lanes: tuple[Polygon, ...],
) -> None:
    """Write the annotated video of one clip from a second decode; a stop request ends it early and readable."""
    config: SpeedConfig = request.config
    places = {f"lane {number}": lane for number, lane in enumerate(lanes, start=1)} | {"region": config.region}
    with _footage(path, request)() as source:
        camera = _camera(ground, source, request.config)
        records = (spool.read(identity) for _, identity in sorted(results.ledger.drawn[path.name]))
        name = path.name
        motions, log, strangers = results.motions[name], results.cameras[name], results.strangers[name]
        with (
            VideoWriter(out, source.width, source.height, source.nominal_rate) as video,
            run_.background(video) as sink,
        ):
            for frame in annotate(run_.frames(source), records, camera, config, motions, log, strangers, places):
                sink.write(frame.image, frame.t)


def _keep_calibration_picture(homography: Path, folder: Path) -> None:
    """Lay the picture that the calibration drew beside its homography, if it did, with the results."""
    picture = homography.with_suffix(".png")
    if picture.is_file():
        with replacing(folder / "calibration.png") as file:
            file.write(picture.read_bytes())
