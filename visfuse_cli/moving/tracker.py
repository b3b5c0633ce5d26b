"""Every target before a moving stereo head, pair by pair: followed, ended, begun where named or found by the flow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager

import numpy as np

from visfuse_cli.moving import target as one
from visfuse_cli.moving.find import Finder
from visfuse_cli.moving.models import Models
from visfuse_cli.moving.settings import FlowSettings, ImmConfig
from visfuse_cli.moving.target import Head, Target
from visfuse_cli.records import Array, GivenTarget, Image, StereoRig
from visfuse_cli.vision import flow as optical
from visfuse_cli.vision import patches
from visfuse_cli.vision.epipolar_match import match
from visfuse_cli.vision.patches import Grey

SMALL_LINES = 480  # up to which Horn-Schunck is the default
Stage = Callable[[str], AbstractContextManager[None]]


class Tracker:
    """Follows all targets; `step` for every pair of straight pictures, `finish` after the last."""

    def __init__(
        self, rig: StereoRig, config: ImmConfig, size: tuple[int, int], given: Sequence[GivenTarget], stage: Stage
    ) -> None:
        self._rig, self._config, self._size, self._stage = rig, config, size, stage
        self._models = Models(config.filter)
        self._finder = None if given else Finder(rig, config, size)
        self._waiting = sorted(enumerate(given, start=1), key=lambda pair: pair[1].frame)
        self._followed: list[Target] = []
        self._next_id = 1
        self._before: tuple[Head, Image, Array | None] | None = None  # head, grey picture, depth
        self.missed: list[str] = []  # what was to be begun and could not be

    def step(self, pictures: Mapping[str, Image], frame: int, head: Head) -> list[Target]:
        """One pair further; returns those that nobody follows any more."""
        with self._stage("pyramids"):
            views = {name: patches.pyramid(picture) for name, picture in pictures.items()}
            grey = np.asarray(views["left"][0], np.uint8)
        with self._stage("flow"):
            flow = dense_flow(self._before[1], grey, self._config.flow) if self._before is not None else None
        with self._stage("filter"):
            for each in self._followed:
                one.follow(each, views, flow, frame, head)
        ended = [each for each in self._followed if self._over(each, head.t)]
        self._followed = [each for each in self._followed if each not in ended]
        self._begin_given(views, frame, head)
        depth = self._newcomers(pictures["left"], views, grey, flow, frame, head) if self._finder is not None else None
        self._before = (head, grey, depth)
        return ended

    def finish(self) -> list[Target]:
        """Those that were followed to the end."""
        for each in self._followed:
            each.ended_by = "end of footage"
        self.missed += [
            f"target {identity} of init.yaml begins at frame {given.frame}, which the footage does not have"
            for identity, given in self._waiting
        ]
        return self._followed

    def _begin_given(self, views: dict[str, list[Grey]], frame: int, head: Head) -> None:
        while self._waiting and self._waiting[0][1].frame <= frame:
            identity, given = self._waiting.pop(0)
            right = (
                match(self._rig, views, given.left, self._config.measure.good) if given.right is None else given.right
            )
            new = None if right is None else self._started(identity, views, (given.left, right), frame, head, given)
            if new is None:
                self.missed.append(f"target {identity} of init.yaml was not found in the right view at frame {frame}")
            else:
                self._followed.append(new)

    def _newcomers(
        self, picture: Image, views: dict[str, list[Grey]], grey: Image, flow: Array | None, frame: int, head: Head
    ) -> Array:
        """Begin what moves by itself and is not followed yet; returns the depth (H, W) m of the left view."""
        assert self._finder is not None
        with self._stage("depth"):
            depth = self._finder.depth(grey, np.asarray(views["right"][0], np.uint8))
        if self._before is None or self._before[2] is None or flow is None:
            return depth
        with self._stage("newcomers"):
            boxes = [each.history[-1].boxes for each in self._followed]
            known = [each["left"] for each in boxes if "left" in each]
            found = self._finder.look(picture, self._before[2], flow, self._before[0], head, known)
        for quad, velocity in found:
            right = match(self._rig, views, quad, self._config.measure.good)
            new = None if right is None else self._started(self._next_id, views, (quad, right), frame, head, velocity)
            if new is not None:
                self._followed.append(new)
                self._next_id += 1
        return depth

    def _started(
        self,
        identity: int,
        views: dict[str, list[Grey]],
        quads: tuple[Array, Array],
        frame: int,
        head: Head,
        known: GivenTarget | Array,
    ) -> Target | None:
        given = isinstance(known, GivenTarget)
        velocity = np.zeros(3) if isinstance(known, GivenTarget) else known
        return one.start(identity, self._rig, self._config, self._models, views, *quads, frame, head, velocity, given)

    def _over(self, target: Target, t: float) -> bool:
        """Whether a track ends here, and why."""
        box = target.history[-1].boxes.get("left")
        if t - target.last_seen > self._config.life.max_coast_s:
            target.ended_by = "lost"
        elif box is None or np.any(box[:2] + box[2:] / 2 < 0) or np.any(box[:2] + box[2:] / 2 > self._size):
            target.ended_by = "left"
        return bool(target.ended_by)


def dense_flow(before: Image, after: Image, settings: FlowSettings) -> Array:
    """Flow (H, W, 2) px between grey pictures (H, W) by the method that is configured."""
    small = settings.method == "auto" and after.shape[0] <= SMALL_LINES
    if settings.method == "horn-schunck" or small:
        return optical.horn_schunck(before, after, settings.smoothness, settings.iterations, settings.sigma)
    return optical.dis(before, after)
