"""`visfuse speed`: one fixed camera, a ground homography, and the speed of everything that moves.

frames -> steady -> background -> regions -> tracker (predict, measure, update) -> conclude -> judge -> tables and video
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from visfuse_cli.config import Section
from visfuse_cli.errors import InputError
from visfuse_cli.files import detections as detection_files
from visfuse_cli.files import homography as homography_files
from visfuse_cli.files.atomic import replacing
from visfuse_cli.files.run_json import write_run_json
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.spool import TrackSpool, write_table
from visfuse_cli.files.video import VideoSource, describe, is_clip_folder, list_clips, open_source
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.files.wall_clock import began, check_pattern, known_zone
from visfuse_cli.maths.cameras import ground_camera
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, GroundCamera, GroundMap, Image, RunRequest, RunResult, TimeAudit
from visfuse_cli.tracking.annotate import UNITS, annotate
from visfuse_cli.tracking.camera_watch import CameraWatch
from visfuse_cli.tracking.conclude import conclude
from visfuse_cli.tracking.foreground import BackgroundSettings, Detections, Detector, MovingRegions, RegionSettings
from visfuse_cli.tracking.ground import GroundTracker
from visfuse_cli.tracking.output import COLUMNS, Polygon, abandoned_row, lane_of, row_of, track_record
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.targets import Abandoned, Track
from visfuse_cli.tracking.verdict import SpeedSettings, judge
from visfuse_cli.vision.background import empty_picture
from visfuse_cli.vision.steady import at_rest

WARMUP_PICTURES = 31
SEEN_FRAMES = 8  # a region seen for fewer frames than this is noise and not worth a line in the ledger


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


class DisplaySettings(Section):
    """Annotation and screen only; tables keep their units."""

    units: Literal["km/h", "mph", "m/s"] = Field("km/h", description="unit of speed on the video and the screen")


class SpeedConfig(TrackerSettings):
    """Configuration of `visfuse speed`."""

    video: VideoSettings = VideoSettings()
    clock: ClockSettings = ClockSettings()
    background: BackgroundSettings = BackgroundSettings()
    regions: RegionSettings = RegionSettings()
    speed: SpeedSettings = SpeedSettings()
    lanes: tuple[Polygon, ...] = Field((), description="polygons of ground points [X, Y] m, numbered from 1")
    display: DisplaySettings = DisplaySettings()

    @field_validator("lanes")
    @classmethod
    def _polygons(cls, lanes: tuple[Polygon, ...]) -> tuple[Polygon, ...]:
        for number, polygon in enumerate(lanes, start=1):
            if len(polygon) < 3:
                raise ValueError(f"lane {number} has {len(polygon)} corners; a polygon needs three or more")
        return lanes


@dataclass(slots=True)
class _Results:
    """What a run has found so far: table rows (small) and where each clip's tracks begin."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    rejected: list[dict[str, Any]] = field(default_factory=list)
    speeds: list[float] = field(default_factory=list)  # m/s
    drawn: dict[str, list[tuple[int, int]]] = field(default_factory=dict)  # clip -> (first frame, id)
    audits: dict[str, TimeAudit] = field(default_factory=dict)
    began: dict[str, datetime | None] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)  # about times of day
    watches: dict[str, CameraWatch] = field(default_factory=dict)


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
    inputs = [
        describe(path) for path in (*clips, request.options["homography"], request.options.get("detections")) if path
    ]
    results = _Results()
    for path in clips:
        with _open(path, request) as source:
            _check_size(source, ground, path)
            moment, doubt = began(path, config.clock.pattern, config.clock.zone, source.creation_time)
            results.began[path.name] = moment
            results.doubts += [doubt] if doubt else []
    with (
        RunFolder(request.out, request.overwrite) as folder,
        Run(request.progress) as run_,
        TrackSpool(folder, "speed", request.seed, "ground") as spool,
    ):
        for doubt in results.doubts:
            run_.warn(doubt)
        next_id = 1
        for path in clips:
            with _open(path, request) as source:
                camera = ground_camera(ground, (source.width, source.height))
                clip = _Clip(path.name, source, camera, config, boxes)
                next_id = _track(clip, run_, spool, results, next_id, path.name if several else None)
            if run_.stopped_by is not None:
                break
        write_table(folder / "speeds.csv", COLUMNS, results.rows)
        write_table(folder / "rejected.csv", (*COLUMNS, "reason"), results.rejected)
        if request.video and run_.stopped_by is None:
            for path in clips:
                if path.name in results.drawn:
                    name = f"annotated-{path.stem}.mp4" if several else "annotated.mp4"
                    _annotate(path, folder / name, ground, request, run_, spool, results)
        _keep_calibration_picture(request.options["homography"], folder)
        summary = _summary(results, run_, config, folder)
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
                "began_utc": {name: _utc(moment, 0.0) or None for name, moment in results.began.items()},
                "camera": {name: watch.report() for name, watch in results.watches.items()},
                "crs": None if ground.reference is None else asdict(ground.reference),
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


def _open(path: Path, request: RunRequest) -> VideoSource:
    return open_source(path, fps=request.config.video.fps, start=request.start, end=request.end)


def _check_size(source: VideoSource, ground: GroundMap, path: Path) -> None:
    size = (source.width, source.height)
    if ground.image_size is not None and size != ground.image_size:
        wide, high = ground.image_size
        raise InputError(
            f"{path}: is {size[0]}x{size[1]}, but the homography was made for {wide}x{high}; calibrate at this size"
        )


def _track(clip: _Clip, run_: Run, spool: TrackSpool, results: _Results, first_id: int, label: str | None) -> int:
    """Follow everything in one clip; returns the next free id."""
    tracker = GroundTracker(clip.camera, clip.config, first_id)
    results.drawn[clip.name] = []
    with run_.stage("warm up"):
        empty = empty_picture(at_rest(_sampled(clip.source, clip.config.background.warmup_s)))
        watch = results.watches[clip.name] = CameraWatch(empty)
        look = _detector(clip, empty)
    for shown in run_.frames(clip.source):
        run_.count("frames")
        with run_.stage("steady"):
            frame = watch.steadied(shown)
        if frame is None:
            continue
        with run_.stage("detect"):
            evidence = look.evidence(frame)
        with run_.stage("track"):
            tracker.predict(frame.t)
            ended = tracker.update(frame.index, evidence)
        with run_.stage("conclude"):
            _settle(*ended, clip, tracker, run_, spool, results, label)
        with run_.stage("learn"):
            look.learn(frame, tracker.outlines())
    _settle(*tracker.finish(), clip, tracker, run_, spool, results, label)
    audit = results.audits[clip.name] = clip.source.audit()
    for warning in (*audit.warnings, *watch.warnings(clip.name)):
        run_.warn(warning)
    return tracker.next_id


def _detector(clip: _Clip, empty: Image) -> Detector:
    if clip.boxes is not None:
        return Detections(clip.camera, clip.boxes)
    config = clip.config
    return MovingRegions(clip.camera, config.background, config.regions, config.target.smallest, empty)


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
    clip: _Clip,
    tracker: GroundTracker,
    run_: Run,
    spool: TrackSpool,
    results: _Results,
    label: str | None,
) -> None:
    """Turn what ended into records and table rows."""
    config, begun = clip.config, results.began[clip.name]
    for track in tracks:
        path = conclude(track, clip.camera, config, tracker.dynamics)
        verdict = judge(path, clip.camera.ground.cov, config.pose.bias_px, config.speed)
        spool.add(track_record(path, verdict, clip.camera, label, results.watches[clip.name].image_from_rest))
        results.drawn[clip.name].append((int(path.frame[0]), path.id))
        lane = lane_of(path.planar.mean[(verdict.first + verdict.last) // 2, :2], config.lanes)
        row = row_of(path, verdict, clip.name, _utc(begun, path.t[verdict.first]), lane)
        if verdict.reason:
            results.rejected.append(row)
            run_.count("rejected")
        else:
            results.rows.append(row)
            results.speeds.append(verdict.speed)
            run_.count("vehicles")
    for candidate in abandoned:
        if candidate.position is not None and candidate.n_frames >= SEEN_FRAMES:
            results.rejected.append(abandoned_row(candidate, clip.name, _utc(begun, candidate.t_start)))
        run_.count("regions that never became a track")


def _utc(begun: datetime | None, t: float) -> str:
    if begun is None:
        return ""
    moment = (begun + timedelta(seconds=float(t))).astimezone(UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _annotate(
    path: Path,
    out: Path,
    ground: GroundMap,
    request: RunRequest,
    run_: Run,
    spool: TrackSpool,
    results: _Results,
) -> None:
    """Write the annotated video of one clip from a second decode; a stop request ends it early and readable."""
    units = request.config.display.units
    with _open(path, request) as source:
        camera = ground_camera(ground, (source.width, source.height))
        records = (spool.read(identity) for _, identity in sorted(results.drawn[path.name]))
        watch = results.watches[path.name]
        with (
            VideoWriter(out, source.width, source.height, source.nominal_rate) as video,
            run_.background(video) as sink,
        ):
            for frame in annotate(run_.frames(source), records, camera, units, watch):
                sink.write(frame.image, frame.t)


def _keep_calibration_picture(homography: Path, folder: Path) -> None:
    """Lay the picture that the calibration drew beside its homography, if it did, with the results."""
    picture = homography.with_suffix(".png")
    if picture.is_file():
        with replacing(folder / "calibration.png") as file:
            file.write(picture.read_bytes())


def _summary(results: _Results, run_: Run, config: SpeedConfig, folder: Path) -> dict[str, Any]:
    factor, units = UNITS[config.display.units], config.display.units
    speeds = np.array(results.speeds) * factor
    return {
        "vehicles": len(results.rows),
        "rejected": len(results.rejected),
        "units": units,
        "median": round(float(np.median(speeds)), 2) if len(speeds) else None,
        "percentile_85": round(float(np.percentile(speeds, 85)), 2) if len(speeds) else None,
        "frames": run_.counts["frames"],
        "time_audit": {
            name: {
                "frames": audit.frames,
                "duration_s": round(audit.duration_s, 3),
                "dropped": audit.dropped,
                "irregular": audit.irregular,
                "duplicated": audit.duplicated,
                "lost": audit.lost,
            }
            for name, audit in results.audits.items()
        },
        "out": str(folder),
    }


def text(result: RunResult) -> str:
    """The summary for people."""
    summary = result.summary
    lines = [f"{'vehicles':<12} {summary['vehicles']}"]
    if summary["vehicles"]:
        lines += [
            f"{'median':<12} {summary['median']:.1f} {summary['units']}",
            f"{'85th perc.':<12} {summary['percentile_85']:.1f} {summary['units']}",
        ]
    lines.append(f"{'rejected':<12} {summary['rejected']} (reasons in rejected.csv)")
    for name, audit in summary["time_audit"].items():
        lines.append(
            f"{'times':<12} {name}: {audit['frames']} frames over {audit['duration_s']:.2f} s, "
            f"{audit['dropped']} dropped, {audit['irregular']} irregular, "
            f"{audit['duplicated']} duplicated, {audit['lost']} lost"
        )
    lines.append(f"{'results':<12} {summary['out']}")
    return "\n".join(lines)
