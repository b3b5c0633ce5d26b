"""Vehicles followed pair by pair: given by hand or found by their motion, until nobody sees them any more."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from visfuse_cli.commands.track_stereo_pf.scene import VIEWS, Scene, pairs
from visfuse_cli.errors import InputError
from visfuse_cli.facing import cloud, front, target
from visfuse_cli.facing.find import Finder, Found
from visfuse_cli.facing.front import Target
from visfuse_cli.facing.look import settle_on
from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.files.video import VideoSource, open_source
from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import triangulated
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, GivenTarget, Image, Lens, RunRequest
from visfuse_cli.vision import patches
from visfuse_cli.vision.empty import empty_picture
from visfuse_cli.vision.epipolar_check import epipolar_residual
from visfuse_cli.vision.epipolar_match import match
from visfuse_cli.vision.patches import Grey

WARMUP_PICTURES = 41
AHEAD_M, AHEAD_S = 50.0, 3.0  # of a provisional way, until the track tells its own
OFF_PX, NONSENSE_PX = 2.0, 25.0  # median distance from epipolar lines: warned of, refused


class Straight:
    """Pictures without distortion, on the calibration's K."""

    def __init__(self, lens: Lens, size: tuple[int, int]) -> None:
        self._maps = None
        if np.any(lens.D):
            self._maps = cv2.initUndistortRectifyMap(lens.K, lens.D, np.eye(3), lens.K, size, cv2.CV_16SC2)

    def picture(self, image: Image) -> Image:
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), np.uint8)


def follow(
    scene: Scene, sources: dict[str, VideoSource], config: StereoConfig, request: RunRequest, run_: Run
) -> Iterator[list[Target]]:
    """Follow every vehicle; yields, pair by pair, those that nobody follows any more."""
    straight = {
        name: Straight(lens, scene.size) for name, lens in (("left", scene.rig.left), ("right", scene.rig.right))
    }
    finder = None
    if not scene.given:
        with run_.stage("warm up"):
            finder = Finder(scene.rig, _empty(scene, request, straight["left"]), config)
    waiting = sorted(enumerate(scene.given, start=1), key=lambda pair: pair[1].frame)
    followed: list[Target] = []
    next_id, first = 1, True
    for pair in pairs(sources, run_):
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
                cloud.predict(each, pair.t)
                target.update(each, views, at)
        ended = [each for each in followed if _over(each, scene, pair.t)]
        followed = [each for each in followed if each not in ended]
        with run_.stage("newcomers"):
            while waiting and waiting[0][1].frame <= at[0]:
                identity, given = waiting.pop(0)
                begun = _begin_given(identity, given, scene, config, views, at, request.seed, run_)
                followed += [begun] if begun is not None else []
            if finder is not None:
                known = [front.left_quad(each) for each in followed]
                for found in finder.look(pictures["left"], pair.t, known):
                    new = _begin_found(next_id, found, scene, config, views, at, request.seed)
                    if new is not None:
                        followed.append(new)
                        next_id += 1
                _settle_on_regions(followed, finder, views, at)
        yield ended
    for each in followed:
        each.ended_by = "end of footage"
    for identity, given in waiting:
        run_.warn(f"target {identity} of init.yaml begins at frame {given.frame}, which the footage does not have")
    yield followed


def _settle_on_regions(
    followed: list[Target], finder: Finder, views: dict[str, list[Grey]], at: tuple[int, float]
) -> None:
    """Let vehicles found unaided keep to the regions that move, where each has one of its own."""
    for each in followed:
        if len(each.looks) > 1 and each.looks[-1].t == at[1]:
            region = finder.around(each.looks[-1].quads["left"])
            if region is not None:
                settle_on(each, views, region, at[1] - each.looks[-2].t)


def _empty(scene: Scene, request: RunRequest, straight: Straight) -> Image:
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
    return empty_picture(pictures, neighbours=False)


def _check_epipolar(scene: Scene, pictures: dict[str, Image], run_: Run) -> None:
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
    scene: Scene,
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
        begun = _begin(identity, given.left, right, given.speed, scene, config, views, at, seed)
    if begun is None:
        run_.warn(f"target {identity} of init.yaml was not found in the right view at frame {at[0]}")
    return begun


def _begin_found(
    identity: int,
    found: Found,
    scene: Scene,
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
    speed, doubt = max(float(np.linalg.norm(velocity)), 1e-3), found.growth_sigma * float(place[2])
    way = scene.way if config.filter.path_constraint else None
    if way is None:
        way = Way(np.stack([place, place + AHEAD_S * max(speed, 0.1) * velocity / speed]))
        return target.start(identity, scene.rig, way, config, views, (left, right), speed, at, seed, doubt, False)
    along = float(way.frame(np.array(way.nearest(place)))[1][:, 0] @ velocity)
    return target.start(identity, scene.rig, way, config, views, (left, right), along, at, seed, doubt, True)


def _begin(
    identity: int,
    left: Array,
    right: Array,
    speed: float | None,
    scene: Scene,
    config: StereoConfig,
    views: dict[str, list[Grey]],
    at: tuple[int, float],
    seed: int,
) -> Target | None:
    """A target on the scene's path, or on one straight at the camera until its track tells better."""
    way = scene.way if config.filter.path_constraint else None
    on_path = way is not None
    if way is None:
        place = triangulated(scene.rig, left.mean(axis=0), right.mean(axis=0))
        if not np.isfinite(place).all() or place[2] <= 0.1:
            return None
        way = Way(np.stack([place, place - [0, 0, AHEAD_M]]))
    return target.start(identity, scene.rig, way, config, views, (left, right), speed, at, seed, None, on_path)


def _over(target: Target, scene: Scene, t: float) -> bool:
    """Whether a track ends here, and why."""
    if front.leaving(target, scene.size):
        target.ended_by = "left"
    elif t - target.last_seen > target.config.life.max_coast_s:
        target.ended_by = "lost"
    return bool(target.ended_by)
