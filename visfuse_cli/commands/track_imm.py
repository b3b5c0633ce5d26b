"""`visfuse track-imm`: a moving stereo camera follows what moves.

pairs of frames and poses -> straight pictures -> targets predicted, found, measured, updated -> newcomers by flow ->
settled tracks -> video
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.run_json import write_run_json
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.scene import check_scene, file, find_file, view
from visfuse_cli.files.sensors import Sensors, read_sensors
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.stereo_calibration import FILES, read_rig
from visfuse_cli.files.stereo_scene import GivenTarget, read_init
from visfuse_cli.files.video import VideoSource, describe, open_source
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.maths import odometry
from visfuse_cli.maths.odometry import Poses
from visfuse_cli.moving import target as one
from visfuse_cli.moving.annotate import UNITS, Drawn, inset, together
from visfuse_cli.moving.conclude import conclude, track_record
from visfuse_cli.moving.find import Finder
from visfuse_cli.moving.models import Models
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.moving.target import Head, Target
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, FrameSet, Image, Lens, RunRequest, RunResult, StereoRig
from visfuse_cli.vision import flow as optical
from visfuse_cli.vision import patches
from visfuse_cli.vision.epipolar_match import match
from visfuse_cli.vision.lens import undistort_points
from visfuse_cli.vision.patches import Grey

__all__ = ["ImmConfig", "run", "text"]

VIEWS = ("left", "right")
AGREE = 0.5  # of the rate's interval, within which two frames make a pair
SMALL_LINES = 480  # up to which Horn-Schunck is the default
BEYOND_S = 0.5  # s that footage may go on beyond the sensors


@dataclass(slots=True)
class _Scene:
    """All that a run needs to know of its scene."""

    rig: StereoRig
    views: dict[str, Path]
    files: list[Path]
    given: list[GivenTarget]
    sensors: Sensors
    size: tuple[int, int]


@dataclass(slots=True)
class _Way:
    """Where the camera was at each pair of frames so far."""

    frame: list[int] = field(default_factory=list)
    T: list[Array] = field(default_factory=list)
    cov: list[Array] = field(default_factory=list)


def run(request: RunRequest) -> RunResult:
    """Follow what moves in a scene; raises a VisfuseError before the first frame on bad input."""
    config: ImmConfig = request.config
    scene = _read(request)
    inputs = [describe(path) for path in (*scene.files, *scene.views.values())]
    begun: list[tuple[int, int]] = []
    way = _Way()
    with (
        RunFolder(request.out, request.overwrite) as folder,
        Run(request.progress) as run_,
        TrackSpool(folder, "track-imm", request.seed, "left-camera-at-start") as spool,
    ):
        for warning in scene.sensors.warnings:
            run_.warn(warning)
        sources = _open(scene, request)
        speeds: list[dict[str, Any]] = []
        for targets in _follow(scene, sources, config, way, run_):
            for target in targets:
                path = conclude(target, _covariances(target, way))
                if path is None:
                    run_.count("dropped")
                    continue
                record = track_record(path, config.latency)
                spool.add(record)
                begun.append((path.frame[0], path.id))
                speeds.append({"id": path.id} | {k: record["summary"][k] for k in ("speed", "distance", "n_frames")})
                run_.count("targets")
        audits = {name: source.audit() for name, source in sources.items()}
        for warning in (text for audit in audits.values() for text in audit.warnings):
            run_.warn(warning)
        if audits["left"].frames != audits["right"].frames:
            frames = " and ".join(f"{audits[name].frames} ({name})" for name in VIEWS)
            run_.warn(f"the views have {frames} frames; pairs go by time")
        if not run_.counts["pairs"] and run_.stopped_by is None:
            raise InputError(f"{request.input}: no frame of one view is near in time to one of the other")
        if request.video and run_.stopped_by is None:
            _annotate(scene, folder, request, run_, spool, begun, way)
        ego = np.stack(way.T) if way.T else np.zeros((0, 3))
        summary = {
            "targets": len(begun),
            "tracks": speeds,
            "pairs": run_.counts["pairs"],
            "ego_distance": float(np.sum(np.linalg.norm(np.diff(ego, axis=0), axis=1))),
            "units": config.display.units,
            "out": str(folder),
        }
        write_run_json(
            folder / "run.json",
            command="track-imm",
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
            extra={"summary": summary, "ego": {"frame": way.frame, "position": ego.round(6).tolist()}},
        )
    return RunResult(request.out, summary, run_.warnings, run_.stopped_by, run_.stages)


def _read(request: RunRequest) -> _Scene:
    """The scene, all of it checked."""
    folder = request.input
    check_scene(folder)
    calibration = file(folder, FILES, "calibration of the pair")
    rig = read_rig(calibration)
    views = {name: view(folder, name) for name in VIEWS}
    sensor_file = file(folder, ("sensors.csv",), "sensors of the camera's motion")
    sensors = read_sensors(sensor_file)
    if sensors.form == "gaze":
        raise InputError(
            f"{sensor_file}: holds gaze angles; a stereo head needs wheels (t,v1,v2) or poses (t,x,z,theta)"
        )
    files, given = [calibration, sensor_file], []
    init = find_file(folder, ("init.yaml", "init.yml"))
    if init is not None:
        files.append(init)
        given = [
            replace(each, left=undistort_points(each.left, rig.left), right=_straight(each.right, rig.right))
            for each in read_init(init)
        ]
    scene = _Scene(rig, views, files, given, sensors, (0, 0))
    sizes = {name: (source.width, source.height) for name, source in _open(scene, request).items()}
    if sizes["left"] != sizes["right"]:
        left, right = ("x".join(map(str, sizes[name])) for name in VIEWS)
        raise InputError(f"{folder}: left is {left} and right is {right}; both views need one size")
    scene.size = sizes["left"]
    _check_size(calibration, rig, scene.size)
    for k, each in enumerate(given):
        if not patches.inside(each.left, scene.size, -2.0):
            raise InputError(f"{init}, targets[{k}], left: lies outside of the {scene.size[0]}x{scene.size[1]} picture")
    return scene


def _straight(quad: Array | None, lens: Lens) -> Array | None:
    return None if quad is None else undistort_points(quad, lens)


def _check_size(calibration: Path, rig: StereoRig, size: tuple[int, int]) -> None:
    if rig.image_size is not None and tuple(rig.image_size) != size:
        named = "x".join(str(int(n)) for n in rig.image_size)
        raise InputError(f"{calibration}: is for {named}, but the footage is {size[0]}x{size[1]}")
    middle = rig.left.K[:2, 2] / np.array(size)
    if np.any(middle < 0.15) or np.any(middle > 0.85):
        raise InputError(
            f"{calibration}: M1 has its principal point at ({rig.left.K[0, 2]:.0f}, {rig.left.K[1, 2]:.0f}), "
            f"which is not near the middle of {size[0]}x{size[1]} footage; it was made for another size"
        )


def _open(scene: _Scene, request: RunRequest) -> dict[str, VideoSource]:
    fps = request.config.video.fps
    return {
        name: open_source(path, fps=fps, start=request.start, end=request.end, camera=name)
        for name, path in scene.views.items()
    }


def _pairs(sources: dict[str, VideoSource], run_: Run) -> Iterator[FrameSet]:
    tolerance = AGREE / max(source.nominal_rate for source in sources.values())
    for pair in run_.synchronise(sources, tolerance):
        if not pair.missing:
            yield pair


def poses(sensors: Sensors, config: ImmConfig, at: Array) -> Poses:
    """The left camera's poses at times `at` (n,) s, in its frame at the first sample at or before frame 0."""
    c, own = sensors.columns, config.odometry
    first = c["t"][max(int(np.searchsorted(c["t"], 1e-9, side="right")) - 1, 0)]
    times = np.concatenate([[first], at])
    if sensors.form == "pose":
        nil = np.zeros_like(c["t"])
        found = odometry.from_track(c["t"], c["x"], c.get("y", nil), c["z"], c["theta"], c.get("pitch", nil), times)
    else:
        left, right = (c["v1"], c["v2"]) if sensors.form == "wheels" else (own.k_t * c["u1"], own.k_t * c["u2"])
        noise = own.noise_share, own.noise
        order = np.argsort(times, kind="stable")
        back = np.argsort(order, kind="stable")
        whole = odometry.from_wheels(
            c["t"], left, right, own.wheel_separation, own.camera_yaw, np.array(own.camera_offset), times[order], noise
        )
        found = Poses(times, *(part[back] for part in (whole.R, whole.T, whole.theta, whole.cov)))
    found = odometry.relative(found, found)
    return Poses(at, found.R[1:], found.T[1:], found.theta[1:], found.cov[1:])


class _Pictures:
    """Straight pictures of both views, on the calibration's K."""

    def __init__(self, rig: StereoRig, size: tuple[int, int]) -> None:
        self._maps = {
            name: cv2.initUndistortRectifyMap(lens.K, lens.D, np.eye(3), lens.K, size, cv2.CV_16SC2)
            for name, lens in (("left", rig.left), ("right", rig.right))
            if np.any(lens.D)
        }

    def straight(self, pair: FrameSet) -> dict[str, Image]:
        """Both views (H, W, 3) of a pair."""
        return {
            name: np.asarray(cv2.remap(pair.frames[name].image, *self._maps[name], cv2.INTER_LINEAR), np.uint8)
            if name in self._maps
            else pair.frames[name].image
            for name in VIEWS
        }


def _follow(
    scene: _Scene, sources: dict[str, VideoSource], config: ImmConfig, way: _Way, run_: Run
) -> Iterator[list[Target]]:
    """Follow every target; yields, pair by pair, those that nobody follows any more."""
    straight, models = _Pictures(scene.rig, scene.size), Models(config.filter)
    finder = None if scene.given else Finder(scene.rig, config, scene.size)
    waiting = sorted(enumerate(scene.given, start=1), key=lambda pair: pair[1].frame)
    followed: list[Target] = []
    next_id = 1
    before: tuple[Head, Image, Array | None] | None = None  # head, grey picture, depth
    for pair in _pairs(sources, run_):
        _check_covered(scene, pair.t)
        run_.count("pairs")
        frame = pair.frames["left"].index
        pose = poses(scene.sensors, config, np.array([pair.t]))
        head = Head(pair.t, pose.R[0], pose.T[0])
        way.frame.append(frame)
        way.T.append(pose.T[0])
        way.cov.append(pose.cov[0])
        with run_.stage("straighten"):
            pictures = straight.straight(pair)
            views = {name: patches.pyramid(picture) for name, picture in pictures.items()}
            grey = np.asarray(views["left"][0], np.uint8)
        with run_.stage("flow"):
            flow = _flow(before[1], grey, config) if before is not None else None
        with run_.stage("filter"):
            for each in followed:
                one.follow(each, views, flow, frame, head)
        ended = [each for each in followed if _over(each, pair.t, scene.size)]
        followed = [each for each in followed if each not in ended]
        while waiting and waiting[0][1].frame <= frame:
            identity, given = waiting.pop(0)
            new = _begin_given(identity, given, scene, config, models, views, frame, head)
            if new is None:
                run_.warn(f"target {identity} of init.yaml was not found in the right view at frame {frame}")
            followed += [new] if new is not None else []
        depth = None
        if finder is not None:
            with run_.stage("depth"):
                depth = finder.depth(grey, np.asarray(views["right"][0], np.uint8))
            if before is not None and before[2] is not None and flow is not None:
                with run_.stage("newcomers"):
                    boxes = [each.history[-1].boxes for each in followed]
                    known = [each["left"] for each in boxes if "left" in each]
                    found = finder.look(pictures["left"], before[2], flow, before[0], head, known)
                for quad, velocity in found:
                    right = match(scene.rig, views, quad, config.measure.good)
                    if right is None:
                        continue
                    new = one.start(
                        next_id, scene.rig, config, models, views, quad, right, frame, head, velocity, False
                    )
                    if new is not None:
                        followed.append(new)
                        next_id += 1
        before = (head, grey, depth)
        yield ended
    for each in followed:
        each.ended_by = "end of footage"
    for identity, given in waiting:
        run_.warn(f"target {identity} of init.yaml begins at frame {given.frame}, which the footage does not have")
    yield followed


def _check_covered(scene: _Scene, t: float) -> None:
    first, last = float(scene.sensors.t[0]), float(scene.sensors.t[-1])
    if t > last + BEYOND_S or t < first - BEYOND_S:
        raise InputError(
            f"{scene.files[1]}: samples run from t = {first:g} to {last:g} s, the footage has a frame at {t:.2f} s; "
            "times count from the first frame"
        )


def _flow(before: Image, after: Image, config: ImmConfig) -> Array:
    settings = config.flow
    small = settings.method == "auto" and after.shape[0] <= SMALL_LINES
    if settings.method == "horn-schunck" or small:
        return optical.horn_schunck(before, after, settings.smoothness, settings.iterations, settings.sigma)
    return optical.dis(before, after)


def _begin_given(
    identity: int,
    given: GivenTarget,
    scene: _Scene,
    config: ImmConfig,
    models: Models,
    views: dict[str, list[Grey]],
    frame: int,
    head: Head,
) -> Target | None:
    right = given.right
    if right is None:
        right = match(scene.rig, views, given.left, config.measure.good)
    if right is None:
        return None
    return one.start(identity, scene.rig, config, models, views, given.left, right, frame, head, np.zeros(3), True)


def _over(target: Target, t: float, size: tuple[int, int]) -> bool:
    """Whether a track ends here, and why."""
    box = target.history[-1].boxes.get("left")
    if t - target.last_seen > target.config.life.max_coast_s:
        target.ended_by = "lost"
    elif box is None or np.any(box[:2] + box[2:] / 2 < 0) or np.any(box[:2] + box[2:] / 2 > size):
        target.ended_by = "left"
    return bool(target.ended_by)


def _covariances(target: Target, way: _Way) -> Array:
    """The camera's covariances (T, 4, 4) at a target's instants."""
    at = {frame: k for k, frame in enumerate(way.frame)}
    return np.stack([way.cov[at[seen.frame]] for seen in target.history])


def _annotate(
    scene: _Scene,
    folder: Path,
    request: RunRequest,
    run_: Run,
    spool: TrackSpool,
    begun: list[tuple[int, int]],
    way: _Way,
) -> None:
    """Write both views side by side with a map, from a second decode."""
    sources = _open(scene, request)
    straight = _Pictures(scene.rig, scene.size)
    tracks = []
    for _, identity in sorted(begun):
        record = spool.read(identity)
        tracks.append(Drawn(record, np.array(record["summary"]["size"]), request.config.display.units))
    index = {frame: k for k, frame in enumerate(way.frame)}
    ego = np.stack(way.T)
    wide, high = 2 * (scene.size[0] // 2 * 2), scene.size[1] // 2 * 2
    rate = sources["left"].nominal_rate
    with VideoWriter(folder / "annotated.mp4", wide, high, rate) as writer, run_.background(writer) as out:
        for pair in _pairs(sources, run_):
            frame = pair.frames["left"].index
            pictures = {name: picture.copy() for name, picture in straight.straight(pair).items()}
            pose = poses(scene.sensors, request.config, np.array([pair.t]))
            head = Head(pair.t, pose.R[0], pose.T[0])
            for track in tracks:
                track.draw(pictures, frame, scene.rig, head)
            picture = together(pictures["left"], pictures["right"])
            inset(picture, [ego], tracks, frame, index[frame])
            out.write(picture, pair.t)


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
    lines.append(f"{'camera':<12} {summary['ego_distance']:.2f} m")
    lines.append(f"{'pairs':<12} {summary['pairs']}")
    lines.append(f"{'results':<12} {summary['out']}")
    return "\n".join(lines)
