"""Every target before a moving stereo head, pair by pair: followed, ended, begun where named or found by the flow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import takewhile

import numpy as np

from visfuse_cli.moving import target as one
from visfuse_cli.moving.find import Finder, Found
from visfuse_cli.moving.head import Head, Pair
from visfuse_cli.moving.models import Models
from visfuse_cli.moving.pursuit import Pursuit, Stage
from visfuse_cli.moving.settings import FlowSettings, ImmConfig
from visfuse_cli.moving.target import Expected, Target
from visfuse_cli.records import Array, Gaussian, GivenTarget, Image, StereoRig
from visfuse_cli.vision import flow as optical
from visfuse_cli.vision import patches
from visfuse_cli.vision.boxes import covered
from visfuse_cli.vision.epipolar_match import match

# Two targets that share so much of a box, are so near (m), and go so much alike (m/s) for so long (s) are one.
TWINS_SHARE, TWINS_M, TWINS_SPEED, TWINS_S = 0.25, 0.45, 0.4, 0.4
SMALL_LINES = 480  # up to which Horn-Schunck is the default


class Tracker(Pursuit[Target, Pair, Expected, Found]):
    """Follows all targets; `step` for every pair of straight pictures, `finish` after the last."""

    unbegun = "was not found in the right view"

    def __init__(
        self, rig: StereoRig, config: ImmConfig, size: tuple[int, int], given: Sequence[GivenTarget], stage: Stage
    ) -> None:
        super().__init__(config, size, given)
        self._rig, self._stage = rig, stage
        self._models, self._finder = Models(config.filter), Finder(rig, config, size)
        self._before: tuple[Head, Image] | None = None

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
        self._part(head.t)
        self._begin_given(pair)
        if self._wanted(head.t):
            with self._stage("newcomers"):
                found = self._finder.look(pair, grey, [each.box for each in self._followed if each.box is not None])
            self._begin_found(found, pair)
        else:
            self._finder.rest()
        self._before = (head, grey)
        return self._forgotten(head.t)

    def _expect(self, target: Target, view: Pair) -> Expected:
        return one.expect(target, view.head)

    def _seek(self, target: Target, view: Pair, where: Expected, hidden: float) -> None:
        one.follow(target, view, where, hidden)

    def _named(self, identity: int, given: GivenTarget, view: Pair) -> Target | None:
        right = self._match(view, given.left) if given.right is None else given.right
        deviation = max(self._config.filter.start_speed, abs(given.speed or 0.0))
        velocity = Gaussian(np.zeros(3), deviation**2 * np.eye(3))
        return None if right is None else self._started(identity, view, given.left, right, velocity, True)

    def _again(self, target: Target, view: Pair, found: Found) -> Array | None:
        return one.found_again(target, view, found.quad.mean(axis=0), found.depth)

    def _begin_found(self, found: Sequence[Found], pair: Pair) -> None:
        """Begin what moves by itself and is not followed yet, or go on with who was lost or away."""
        for each in found:
            velocity = Gaussian(each.velocity, self._config.filter.start_speed**2 * np.eye(3))
            old, own = self._known(pair, each)
            if old is None and self._given:
                continue  # who is followed was said
            quad = each.quad if own is None else own
            right = self._match(pair, quad)
            identity, given = (self._next_id, False) if old is None else (old.id, old.given)
            new = None if right is None else self._started(identity, pair, quad, right, velocity, given)
            if new is not None:
                self._take(new, old)

    def _twin(self, target: Target, t: float) -> bool:
        """Whether a target that was found has for some time been where an older one is, and gone as that goes."""
        own, belief = target.box, target.belief
        near = False
        for other in takewhile(lambda each: each is not target, self._followed):
            box, there = other.box, other.belief
            if own is None or box is None or covered(own, _grown(box)) < TWINS_SHARE:
                continue
            away = float(np.linalg.norm(belief.mean[:3] - there.mean[:3]))
            near |= away < TWINS_M and float(np.linalg.norm(belief.mean[3:6] - there.mean[3:6])) < TWINS_SPEED
        target.alone_at = target.alone_at if near else t
        return not target.given and t - target.alone_at > TWINS_S

    def _match(self, pair: Pair, quad: Array) -> Array | None:
        """The right quad (4, 2) of a left one, over all depths."""
        views = {"left": pair.levels, "right": patches.pyramid(pair.pictures["right"])}
        beyond = quad[:, 0].min() < patches.side(quad)[0]  # its left part may be out of the right view
        part = quad + np.array([[0.5, 0], [0, 0], [0, 0], [0.5, 0]]) * patches.side(quad)[0] if beyond else quad
        found = match(self._rig, views, part, self._config.measure.good)
        return None if found is None else found + quad - part

    def _started(
        self, identity: int, pair: Pair, left: Array, right: Array, velocity: Gaussian, given: bool
    ) -> Target | None:
        return one.start(identity, self._rig, self._config, self._models, pair, left, right, velocity, given)


def _grown(box: Array) -> Array:
    """A box [x, y, w, h] and a third of it to both sides."""
    return box + np.array([-1 / 3, 0, 2 / 3, 0]) * box[2]


def dense_flow(before: Image, after: Image, settings: FlowSettings) -> Array:
    """Flow (H, W, 2) px between grey pictures (H, W) by the method that is configured."""
    small = settings.method == "auto" and after.shape[0] <= SMALL_LINES
    if settings.method == "horn-schunck" or small:
        return optical.horn_schunck(before, after, settings.smoothness, settings.iterations, settings.sigma)
    return optical.dis(before, after)
