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
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, GivenTarget, Image, Lens, RunRequest
from visfuse_cli.vision import patches
from visfuse_cli.vision.empty import empty_picture
from visfuse_cli.vision.epipolar_check import epipolar_residual
from visfuse_cli.vision.epipolar_match import match
from visfuse_cli.vision.patches import Grey

WARMUP_PICTURES = 41
AHEAD_M, AHEAD_S = 50.0, 3.0  # of a provisional way, until the track tells its own
Views = dict[str, list[Grey]]  # pyramids by view
At = tuple[int, float]  # number and time (s) of a pair
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
    follower, first = Follower(scene, config, request.seed, finder, run_), True
    for pair in pairs(sources, run_):
        run_.count("pairs")
        with run_.stage("straighten"):
            pictures = {name: straight[name].picture(pair.frames[name].image) for name in VIEWS}
            views = {name: patches.pyramid(picture) for name, picture in pictures.items()}
        if first:
            _check_epipolar(scene, pictures, run_)
            first = False
        yield follower.step(pictures["left"], views, (pair.frames["left"].index, pair.t))
    yield follower.finish()


class Follower:
    """Follows the vehicles of a scene; `step` for every pair of straight pictures, `finish` after the last."""

    def __init__(self, scene: Scene, config: StereoConfig, seed: int, finder: Finder | None, run_: Run) -> None:
        self._scene, self._config, self._seed, self._finder, self._run = scene, config, seed, finder, run_
        self._way = scene.way if config.filter.path_constraint else None
        self._waiting = sorted(enumerate(scene.given, start=1), key=lambda pair: pair[1].frame)
        self._followed: list[Target] = []
        self._next_id = 1

    def step(self, left: Image, views: Views, at: At) -> list[Target]:
        """One pair further, the left picture and both pyramids; returns those that nobody follows any more."""
        with self._run.stage("filter"):
            for each in self._followed:
                cloud.predict(each, at[1])
                target.update(each, views, at)
        ended = [each for each in self._followed if _over(each, self._scene, at[1])]
        self._followed = [each for each in self._followed if each not in ended]
        with self._run.stage("newcomers"):
            while self._waiting and self._waiting[0][1].frame <= at[0]:
                identity, given = self._waiting.pop(0)
                new = self._given(identity, given, views, at)
                if new is None:
                    self._run.warn(f"target {identity} of init.yaml was not found in the right view at frame {at[0]}")
                self._followed += [new] if new is not None else []
            if self._finder is not None:
                known = [front.left_quad(each) for each in self._followed]
                for found in self._finder.look(left, at[1], known):
                    new = self._found(found, views, at)
                    self._followed += [new] if new is not None else []
                    self._next_id += new is not None
                self._settle_on_regions(self._finder, views, at)
        return ended

    def finish(self) -> list[Target]:
        """Those that were followed to the end."""
        for each in self._followed:
            each.ended_by = "end of footage"
        for identity, given in self._waiting:
            self._run.warn(
                f"target {identity} of init.yaml begins at frame {given.frame}, which the footage does not have"
            )
        return self._followed

    def _given(self, identity: int, given: GivenTarget, views: Views, at: At) -> Target | None:
        """A named target on the scene's path, or on one straight at the camera until its track tells better."""
        quads = self._quads(given.left, given.right, views)
        if quads is None:
            return None
        if self._way is not None:
            return self._begin(identity, self._way, views, quads, given.speed, at)
        place = front.place_of(self._scene.rig, *quads)
        ahead = None if place is None else Way(np.stack([place, place - [0, 0, AHEAD_M]]))
        return None if ahead is None else self._begin(identity, ahead, views, quads, given.speed, at)

    def _found(self, found: Found, views: Views, at: At) -> Target | None:
        """A target where something moves, along the scene's path, or along its own motion so far."""
        rig, quads = self._scene.rig, self._quads(found.quad, None, views)
        place = None if quads is None else front.place_of(rig, *quads)
        if quads is None or place is None:
            return None
        velocity, doubt = found.velocity(rig, place), found.growth_sigma * float(place[2])
        if self._way is not None:
            along = float(self._way.frame(np.array(self._way.nearest(place)))[1][:, 0] @ velocity)
            return self._begin(self._next_id, self._way, views, quads, along, at, doubt)
        speed = max(float(np.linalg.norm(velocity)), 1e-3)
        way = Way(np.stack([place, place + AHEAD_S * max(speed, 0.1) * velocity / speed]))
        return self._begin(self._next_id, way, views, quads, speed, at, doubt)

    def _quads(self, left: Array, right: Array | None, views: Views) -> tuple[Array, Array] | None:
        """Left and right quads (4, 2) px, the right one looked for where it is not known."""
        if right is None:
            right = match(self._scene.rig, views, left, self._config.observation.good)
        return None if right is None else (left, right)

    def _begin(
        self,
        identity: int,
        way: Way,
        views: Views,
        quads: tuple[Array, Array],
        speed: float | None,
        at: At,
        doubt: float | None = None,
    ) -> Target | None:
        rig, on_path = self._scene.rig, self._way is not None
        return target.start(identity, rig, way, self._config, views, quads, speed, at, self._seed, doubt, on_path)

    def _settle_on_regions(self, finder: Finder, views: Views, at: At) -> None:
        """Let vehicles found unaided keep to the regions that move, where each has one of its own."""
        for each in self._followed:
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


def _over(target: Target, scene: Scene, t: float) -> bool:
    """Whether a track ends here, and why."""
    if front.leaving(target, scene.size):
        target.ended_by = "left"
    elif t - target.last_seen > target.config.life.max_coast_s:
        target.ended_by = "lost"
    return bool(target.ended_by)
