"""`visfuse track-stereo-pf`: the speed of vehicles that face a static stereo pair.

pairs of frames -> straight pictures -> fronts followed by particles and aligned -> newcomers -> settled tracks -> video
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.facing import target as front
from visfuse_cli.facing.annotate import UNITS, Drawn, together, together_size
from visfuse_cli.facing.conclude import conclude
from visfuse_cli.facing.find import Finder, Found
from visfuse_cli.facing.output import track_record
from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.facing.target import Target
from visfuse_cli.files.folders import paths_of
from visfuse_cli.files.run_json import write_run_json
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.scene import check_scene, file, find_file, view
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.stereo_calibration import FILES, read_rig
from visfuse_cli.files.stereo_scene import GivenPath, read_init, read_path
from visfuse_cli.files.video import VideoSource, describe, open_source
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.maths import paths
from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import triangulated
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, FrameSet, GivenTarget, Image, Lens, RunRequest, RunResult, StereoRig
from visfuse_cli.vision import patches
from visfuse_cli.vision.empty import empty_picture
from visfuse_cli.vision.epipolar_check import epipolar_residual
from visfuse_cli.vision.epipolar_match import match
from visfuse_cli.vision.lens import undistort_points
from visfuse_cli.vision.patches import Grey

__all__ = ["StereoConfig", "run", "text"]

VIEWS = ("left", "right")
WARMUP_PICTURES = 41
AHEAD_M, AHEAD_S = 50.0, 3.0  # of a provisional way, until the track tells its own
OFF_PX, NONSENSE_PX = 2.0, 25.0  # median distance from epipolar lines: warned of, refused
AGREE = 0.5  # of the rate's interval, within which two frames make a pair


@dataclass(slots=True)
class _Scene:
    """All that a run needs to know of its scene."""

    rig: StereoRig
    views: dict[str, Path]
    files: list[Path]
    given: list[GivenTarget]
    way: Way | None
    size: tuple[int, int]


@dataclass(slots=True)
class _Results:
    begun: list[tuple[int, int]] = field(default_factory=list)  # first frame, id
    speeds: list[dict[str, Any]] = field(default_factory=list)
    dropped: int = 0


class _Straight:
    """Pictures without distortion, on the calibration's K."""

    def __init__(self, lens: Lens, size: tuple[int, int]) -> None:
        self._maps = None
        if np.any(lens.D):
            self._maps = cv2.initUndistortRectifyMap(lens.K, lens.D, np.eye(3), lens.K, size, cv2.CV_16SC2)

    def picture(self, image: Image) -> Image:
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), np.uint8)


def run(request: RunRequest) -> RunResult:
    """Measure the vehicles of a scene; raises a VisfuseError before the first frame on bad input."""
    config: StereoConfig = request.config
    scene = _read(request)
    inputs = [describe(path) for path in (*scene.files, *scene.views.values())]
    results = _Results()
    with (
        RunFolder(request.out, request.overwrite, inputs=[request.input, *paths_of(inputs)]) as folder,
        Run(request.progress) as run_,
        TrackSpool(folder, "track-stereo-pf", request.seed, "left-camera") as spool,
    ):
        sources = _open(scene, request)
        for targets in _follow(scene, sources, config, request, run_):
            with run_.stage("settle"):
                _settle(targets, scene, spool, results, run_)
        audits = {name: source.audit() for name, source in sources.items()}
        for warning in (text for audit in audits.values() for text in audit.warnings):
            run_.warn(warning)
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
        write_run_json(
            folder / "run.json",
            command="track-stereo-pf",
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
    """The scene, all of it checked."""
    folder = request.input
    check_scene(folder)
    calibration = file(folder, FILES, "calibration of the pair")
    rig = read_rig(calibration)
    views = {name: view(folder, name) for name in VIEWS}
    files, given, way = [calibration], [], None
    init, path = find_file(folder, ("init.yaml", "init.yml")), find_file(folder, ("path.yaml", "path.yml"))
    if init is not None:
        files.append(init)
        given = [_straight_target(each, rig) for each in read_init(init)]
    if path is not None:
        files.append(path)
        way = _way(path, read_path(path), rig)
    scene = _Scene(rig, views, files, given, way, (0, 0))
    sizes = {}
    for name, source in _open(scene, request).items():
        sizes[name] = (source.width, source.height)
    if sizes["left"] != sizes["right"]:
        left, right = ("x".join(map(str, sizes[name])) for name in VIEWS)
        raise InputError(f"{folder}: left is {left} and right is {right}; both views need one size")
    scene.size = sizes["left"]
    _check_size(calibration, rig, scene.size)
    for k, each in enumerate(given):
        _check_quads(f"{init}, targets[{k}]", each, scene.size)
    return scene


def _check_size(calibration: Path, rig: StereoRig, size: tuple[int, int]) -> None:
    if rig.image_size is not None and tuple(rig.image_size) != size:
        named = "x".join(str(int(n)) for n in rig.image_size)
        raise InputError(f"{calibration}: is for {named}, but the footage is {size[0]}x{size[1]}")
    for name, lens in (("M1", rig.left), ("M2", rig.right)):
        middle = lens.K[:2, 2] / np.array(size)
        if np.any(middle < 0.15) or np.any(middle > 0.85):
            raise InputError(
                f"{calibration}: {name} has its principal point at ({lens.K[0, 2]:.0f}, {lens.K[1, 2]:.0f}), which is "
                f"not near the middle of {size[0]}x{size[1]} footage; it was made for another size"
            )


def _check_quads(where: str, each: GivenTarget, size: tuple[int, int]) -> None:
    for name, quad in (("left", each.left), ("right", each.right)):
        if quad is not None and not patches.inside(quad, size, -0.5):
            raise InputError(f"{where}, {name}: lies outside of the {size[0]}x{size[1]} picture")


def _straight_target(each: GivenTarget, rig: StereoRig) -> GivenTarget:
    right = None if each.right is None else undistort_points(each.right, rig.right)
    return replace(each, left=undistort_points(each.left, rig.left), right=right)


def _way(path: Path, given: GivenPath, rig: StereoRig) -> Way:
    """The path in space; raises InputError where its images do not fit one."""
    try:
        if given.points is not None:
            return Way(given.points)
        assert given.left is not None
        assert given.right is not None
        left, right = undistort_points(given.left, rig.left), undistort_points(given.right, rig.right)
        return paths.straight(rig, left, right) if len(left) == 2 else paths.curved(rig, left, right)
    except ValueError as problem:
        raise InputError(f"{path}: {problem}") from problem


def _open(scene: _Scene, request: RunRequest) -> dict[str, VideoSource]:
    fps = request.config.video.fps
    return {
        name: open_source(path, fps=fps, start=request.start, end=request.end, camera=name)
        for name, path in scene.views.items()
    }


def _pairs(sources: dict[str, VideoSource], run_: Run) -> Iterator[FrameSet]:
    """Pairs of frames near in time."""
    tolerance = AGREE / max(source.nominal_rate for source in sources.values())
    for pair in run_.synchronise(sources, tolerance):
        if not pair.missing:
            yield pair


def _follow(
    scene: _Scene, sources: dict[str, VideoSource], config: StereoConfig, request: RunRequest, run_: Run
) -> Iterator[list[Target]]:
    """Follow every vehicle; yields, pair by pair, those that nobody follows any more."""
    straight = {
        name: _Straight(lens, scene.size) for name, lens in (("left", scene.rig.left), ("right", scene.rig.right))
    }
    finder = None
    if not scene.given:
        with run_.stage("warm up"):
            finder = Finder(scene.rig, _empty(scene, request, straight["left"]), config)
    waiting = sorted(enumerate(scene.given, start=1), key=lambda pair: pair[1].frame)
    followed: list[Target] = []
    next_id, first = 1, True
    for pair in _pairs(sources, run_):
        run_.count("pairs")
        at = (pair.frames["left"].index, pair.t)
        with run_.stage("straighten"):
            pictures = {name: straight[name].picture(pair.frames[name].image) for name in VIEWS}
            views = {name: patches.pyramid(picture) for name, picture in pictures.items()}
        if first:
            _check_epipolar(scene, pictures, run_)
            first = False
        with run_.stage("filter"):
            for each in followed:
                front.predict(each, pair.t)
                front.update(each, views, at)
        ended = [each for each in followed if _over(each, scene, pair.t)]
        followed = [each for each in followed if each not in ended]
        with run_.stage("newcomers"):
            while waiting and waiting[0][1].frame <= at[0]:
                identity, given = waiting.pop(0)
                begun = _begin_given(identity, given, scene, config, views, at, request.seed, run_)
                followed += [begun] if begun is not None else []
            if finder is not None:
                for found in finder.look(pictures["left"], pair.t, [front.left_quad(each) for each in followed]):
                    new = _begin_found(next_id, found, scene, config, views, at, request.seed)
                    if new is not None:
                        followed.append(new)
                        next_id += 1
        yield ended
    for each in followed:
        each.ended_by = "end of footage"
    for identity, given in waiting:
        run_.warn(f"target {identity} of init.yaml begins at frame {given.frame}, which the footage does not have")
    yield followed


def _empty(scene: _Scene, request: RunRequest, straight: _Straight) -> Image:
    """The left view without vehicles, from pictures spread over the first part of the footage."""
    source = open_source(scene.views["left"], fps=request.config.video.fps, start=None, end=None, camera="left")
    warmup = request.config.detection.warmup_s
    span = warmup * source.nominal_rate
    if source.frame_count is not None:
        span = min(span, source.frame_count)
    step, pictures = max(1, int(span / WARMUP_PICTURES)), []
    for number, frame in enumerate(source.frames()):
        if frame.t >= warmup:
            break
        if number % step == 0:
            pictures.append(straight.picture(frame.image))
    if not pictures:
        raise InputError(f"{scene.views['left']}: holds no frame")
    return empty_picture(pictures)


def _check_epipolar(scene: _Scene, pictures: dict[str, Image], run_: Run) -> None:
    found = epipolar_residual(scene.rig, pictures["left"], pictures["right"])
    if found is None or found[0] <= OFF_PX:
        return
    said = (
        f"{scene.files[0]}: {found[1]} features matched between the views lie {found[0]:.1f} px off their epipolar "
        "lines in the median"
    )
    if found[0] > NONSENSE_PX:
        raise InputError(f"{said}; this is not the calibration of this footage, or left and right are exchanged")
    run_.warn(f"{said}; the pair has moved since it was calibrated, or the views are not of one instant")


def _begin_given(
    identity: int,
    given: GivenTarget,
    scene: _Scene,
    config: StereoConfig,
    views: dict[str, list[Grey]],
    at: tuple[int, float],
    seed: int,
    run_: Run,
) -> Target | None:
    right = given.right
    if right is None:
        right = match(scene.rig, views, given.left, config.observation.good)
    begun = None
    if right is not None:
        begun = _begin(identity, given.left, right, given.speed, scene, config, views, at, seed, True)
    if begun is None:
        run_.warn(f"target {identity} of init.yaml was not found in the right view at frame {at[0]}")
    return begun


def _begin_found(
    identity: int,
    found: Found,
    scene: _Scene,
    config: StereoConfig,
    views: dict[str, list[Grey]],
    at: tuple[int, float],
    seed: int,
) -> Target | None:
    """A target where something moves, along the scene's path, or along its own motion so far."""
    left = found.quad
    right = match(scene.rig, views, left, config.observation.good)
    if right is None:
        return None
    place = triangulated(scene.rig, left.mean(axis=0), right.mean(axis=0))
    if not np.isfinite(place).all() or place[2] <= 0.1:
        return None
    velocity = found.velocity(scene.rig, place)
    speed = max(float(np.linalg.norm(velocity)), 1e-3)
    way = scene.way if config.filter.path_constraint else None
    if way is None:
        way = Way(np.stack([place, place + AHEAD_S * max(speed, 0.1) * velocity / speed]))
        return front.start(identity, scene.rig, way, config, views, (left, right), speed, at, seed, False, False)
    along = float(way.frame(np.array(way.nearest(place)))[1][:, 0] @ velocity)
    return front.start(identity, scene.rig, way, config, views, (left, right), along, at, seed, False, True)


def _begin(
    identity: int,
    left: Array,
    right: Array,
    speed: float | None,
    scene: _Scene,
    config: StereoConfig,
    views: dict[str, list[Grey]],
    at: tuple[int, float],
    seed: int,
    given: bool,
) -> Target | None:
    """A target on the scene's path, or on one straight at the camera until its track tells better."""
    way = scene.way if config.filter.path_constraint else None
    on_path = way is not None
    if way is None:
        place = triangulated(scene.rig, left.mean(axis=0), right.mean(axis=0))
        if not np.isfinite(place).all() or place[2] <= 0.1:
            return None
        way = Way(np.stack([place, place - [0, 0, AHEAD_M]]))
    return front.start(identity, scene.rig, way, config, views, (left, right), speed, at, seed, given, on_path)


def _over(target: Target, scene: _Scene, t: float) -> bool:
    """Whether a track ends here, and why."""
    if front.leaving(target, scene.size):
        target.ended_by = "left"
    elif t - target.last_seen > target.config.life.max_coast_s:
        target.ended_by = "lost"
    return bool(target.ended_by)


def _settle(targets: list[Target], scene: _Scene, spool: TrackSpool, results: _Results, run_: Run) -> None:
    for target in targets:
        settled = conclude(target)
        if settled is None:
            results.dropped += 1
            run_.count("dropped")
            continue
        record = track_record(settled, scene.rig)
        spool.add(record)
        results.begun.append((settled.frame[0], settled.id))
        results.speeds.append(
            {"id": settled.id} | {k: record["summary"][k] for k in ("speed", "speed_ci95", "distance")}
        )
        run_.count("vehicles")


def _annotate(
    scene: _Scene, folder: Path, request: RunRequest, run_: Run, spool: TrackSpool, results: _Results
) -> None:
    """Write both views side by side, from a second decode."""
    sources = _open(scene, request)
    drawn = [
        Drawn(spool.read(identity), scene.rig, request.config.display.units) for _, identity in sorted(results.begun)
    ]
    size = together_size(*scene.size)
    with (
        VideoWriter(folder / "annotated.mp4", *size, sources["left"].nominal_rate) as writer,
        run_.background(writer) as out,
    ):
        for pair in _pairs(sources, run_):
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
