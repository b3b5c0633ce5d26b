"""Every target before a moving stereo head, pair by pair: followed, ended, begun where named or found by the flow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager

import numpy as np

from visfuse_cli.moving import target as one
from visfuse_cli.moving.find import Finder, Found
from visfuse_cli.moving.models import Models
from visfuse_cli.moving.settings import FlowSettings, ImmConfig
from visfuse_cli.moving.target import Head, Pair, Target
from visfuse_cli.records import Array, Gaussian, GivenTarget, Image, StereoRig
from visfuse_cli.vision import flow as optical
from visfuse_cli.vision import patches
from visfuse_cli.vision.boxes import box_of, covered
from visfuse_cli.vision.epipolar_match import match
from visfuse_cli.vision.looks import COASTED_S, HIDDEN

# Two targets that share so much of a box, are so near (m), and go so much alike (m/s) for so long (s) are one.
TWINS_SHARE, TWINS_M, TWINS_SPEED, TWINS_S = 0.25, 0.45, 0.4, 0.4
SMALL_LINES = 480  # up to which Horn-Schunck is the default
Stage = Callable[[str], AbstractContextManager[None]]


class Tracker:
    """Follows all targets; `step` for every pair of straight pictures, `finish` after the last."""

    def __init__(
        self, rig: StereoRig, config: ImmConfig, size: tuple[int, int], given: Sequence[GivenTarget], stage: Stage
    ) -> None:
        self._rig, self._config, self._size, self._stage = rig, config, size, stage
        self._models = Models(config.filter)
        self._finder, self._given = Finder(rig, config, size), bool(given)
        self._waiting = sorted(enumerate(given, start=1), key=lambda pair: pair[1].frame)
        self._followed: list[Target] = []
        self._gone: list[Target] = []  # but remembered: they may come back
        self._next_id = 1
        self._before: tuple[Head, Image] | None = None
        self.missed: list[str] = []  # what was to be begun and could not be

    def step(self, pictures: Mapping[str, Image], frame: int, head: Head) -> list[Target]:
        """One pair further; returns those that nobody follows or waits for any more."""
        with self._stage("pyramids"):
            levels = patches.pyramid(pictures["left"])
            grey = np.asarray(levels[0], np.uint8)
        with self._stage("flow"):
            flow = dense_flow(self._before[1], grey, self._config.flow) if self._before is not None else None
        pair = Pair(frame, head, pictures, levels, flow)
        with self._stage("filter"):
            self._follow(pair)
        self._followed = [each for each in self._followed if not self._twin(each, head.t)]
        self._gone += [each for each in self._followed if self._over(each, head.t)]
        self._followed = [each for each in self._followed if not each.ended_by]
        self._begin_given(pair)
        if not self._given or self._gone or self._lost(head.t):
            with self._stage("newcomers"):
                boxes = [each.history[-1].boxes["left"] for each in self._followed if each.history[-1].boxes]
                found = self._finder.look(pair, grey, boxes)
            self._begin_found(found, pair)
        else:
            self._finder.rest()
        self._before = (head, grey)
        over = [each for each in self._gone if head.t - each.last_seen > self._config.life.memory_s]
        self._gone = [each for each in self._gone if each not in over]
        return over

    def finish(self) -> list[Target]:
        """Those that were followed to the end, or waited for."""
        for each in self._followed:
            each.ended_by = "end of footage"
        self.missed += [
            f"target {identity} of init.yaml begins at frame {given.frame}, which the footage does not have"
            for identity, given in self._waiting
        ]
        return self._gone + self._followed

    def _follow(self, pair: Pair) -> None:
        """Follow everyone, the nearest first: what stands behind one of them is hidden, and not looked for."""
        expected = [(one.expect(each, pair.head), each) for each in self._followed]
        taken: list[Array] = []  # boxes
        for where, target in sorted(expected, key=lambda pair: pair[0].depth):
            own = box_of(where.quads["left"]) if where.quads else None
            hidden = max((covered(own, box) for box in taken), default=0.0) if own is not None else 0.0
            one.follow(target, pair, where, hidden)
            if target.history[-1].boxes and (target.history[-1].measured or hidden < HIDDEN):
                taken.append(target.history[-1].boxes["left"])

    def _begin_given(self, pair: Pair) -> None:
        while self._waiting and self._waiting[0][1].frame <= pair.frame:
            identity, given = self._waiting.pop(0)
            right = self._match(pair, given.left) if given.right is None else given.right
            deviation = max(self._config.filter.start_speed, abs(given.speed or 0.0))
            velocity = Gaussian(np.zeros(3), deviation**2 * np.eye(3))
            new = None if right is None else self._started(identity, pair, given.left, right, velocity, True)
            if new is None:
                self.missed.append(
                    f"target {identity} of init.yaml was not found in the right view at frame {pair.frame}"
                )
            else:
                self._followed.append(new)

    def _begin_found(self, found: Sequence[Found], pair: Pair) -> None:
        """Begin what moves by itself and is not followed yet, or go on with who was lost or away."""
        for each in found:
            velocity = Gaussian(each.velocity, self._config.filter.start_speed**2 * np.eye(3))
            old, quad = self._known(each, pair)
            if old is None and self._given:
                continue  # who is followed was said
            right = self._match(pair, quad)
            identity, given = (self._next_id, False) if old is None else (old.id, old.given)
            new = None if right is None else self._started(identity, pair, quad, right, velocity, given)
            if new is None:
                continue
            if old is None:
                self._next_id += 1
            else:
                new.earlier, new.size, new.looks = old, old.size, old.looks
                for group in (self._gone, self._followed):
                    group[:] = [other for other in group if other is not old]
            self._followed.append(new)

    def _known(self, found: Found, pair: Pair) -> tuple[Target | None, Array]:
        """Who of those that are lost or away was found, and where (4, 2) px; else nobody, and the quad as it is."""
        for old in sorted([*self._lost(pair.head.t), *self._gone], key=lambda each: -each.last_seen):
            quad = one.found_again(old, pair, found.quad.mean(axis=0), found.depth)
            if quad is not None:
                return old, quad
        return None, found.quad

    def _twin(self, target: Target, t: float) -> bool:
        """Whether a target that was found has for some time been where an older one is, and gone as that goes."""
        own, belief = target.history[-1].boxes.get("left"), target.belief
        near = False
        for other in self._followed[: self._followed.index(target)]:
            box, there = other.history[-1].boxes.get("left"), other.belief
            if own is None or box is None or covered(own, _grown(box)) < TWINS_SHARE:
                continue
            away = float(np.linalg.norm(belief.mean[:3] - there.mean[:3]))
            near |= away < TWINS_M and float(np.linalg.norm(belief.mean[3:6] - there.mean[3:6])) < TWINS_SPEED
        target.alone_at = target.alone_at if near else t
        return not target.given and t - target.alone_at > TWINS_S

    def _lost(self, t: float) -> list[Target]:
        return [each for each in self._followed if t - each.last_seen > COASTED_S]

    def _match(self, pair: Pair, quad: Array) -> Array | None:
        """The right quad (4, 2) of a left one, over all depths."""
        views = {"left": pair.levels, "right": patches.pyramid(pair.pictures["right"])}
        return match(self._rig, views, quad, self._config.measure.good)

    def _started(
        self, identity: int, pair: Pair, left: Array, right: Array, velocity: Gaussian, given: bool
    ) -> Target | None:
        return one.start(identity, self._rig, self._config, self._models, pair, left, right, velocity, given)

    def _over(self, target: Target, t: float) -> bool:
        """Whether a track ends here, and why."""
        box = target.history[-1].boxes.get("left")
        if t - target.last_seen > self._config.life.max_coast_s:
            target.ended_by = "lost"
        elif box is None or np.any(box[:2] + box[2:] / 2 < 0) or np.any(box[:2] + box[2:] / 2 > self._size):
            target.ended_by = "left"
        return bool(target.ended_by)


def _grown(box: Array) -> Array:
    """A box [x, y, w, h] and a third of it to both sides."""
    return box + np.array([-1 / 3, 0, 2 / 3, 0]) * box[2]


def dense_flow(before: Image, after: Image, settings: FlowSettings) -> Array:
    """Flow (H, W, 2) px between grey pictures (H, W) by the method that is configured."""
    small = settings.method == "auto" and after.shape[0] <= SMALL_LINES
    if settings.method == "horn-schunck" or small:
        return optical.horn_schunck(before, after, settings.smoothness, settings.iterations, settings.sigma)
    return optical.dis(before, after)
