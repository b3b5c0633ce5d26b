"""Every target before a pan-tilt head, frame by frame: followed, ended, begun where named or found by normal flow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import numpy as np

from visfuse_cli.gazing import target as one
from visfuse_cli.gazing.find import Finder, View
from visfuse_cli.gazing.head import Head
from visfuse_cli.gazing.models import Courses
from visfuse_cli.gazing.target import Target
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, GivenTarget, Image
from visfuse_cli.vision import patches
from visfuse_cli.vision.boxes import box_of, covered
from visfuse_cli.vision.looks import COASTED_S

Stage = Callable[[str], AbstractContextManager[None]]


class Tracker:
    """Follows all targets; `step` for every straight picture, `finish` after the last."""

    def __init__(
        self, head: Head, config: ImmConfig, size: tuple[int, int], given: Sequence[GivenTarget], stage: Stage
    ) -> None:
        self._head, self._config, self._size, self._stage = head, config, size, stage
        self._models = Courses(config.filter)
        self._finder = None if given else Finder(head, config)
        self._waiting = sorted(enumerate(given, start=1), key=lambda pair: pair[1].frame)
        self._followed: list[Target] = []
        self._gone: list[Target] = []  # but remembered: they may come back
        self._next_id = 1
        self.missed: list[str] = []  # what was to be begun and could not be

    def step(self, picture: Image, frame: int, t: float, gaze: Array) -> list[Target]:
        """One picture further; returns those that nobody follows any more."""
        with self._stage("pyramids"):
            view = View(frame, t, gaze, picture, patches.pyramid(picture), [])
        with self._stage("filter"):
            self._follow(view)
        self._gone += [each for each in self._followed if self._over(each, t)]
        self._followed = [each for each in self._followed if not each.ended_by]
        view.known.extend(each.looks[-1].box for each in self._followed)
        self._begin_given(view)
        if self._finder is not None:
            with self._stage("newcomers"):
                found, since = self._finder.look(view)
                self._begin_found(found, since)
        over = [each for each in self._gone if t - each.last_seen > self._config.life.memory_s]
        self._gone = [each for each in self._gone if each not in over]
        return over

    def finish(self) -> list[Target]:
        """Those that were followed to the end."""
        for each in self._followed:
            each.ended_by = "end of footage"
        self.missed += [
            f"target {identity} of init.yaml begins at frame {given.frame}, which the footage does not have"
            for identity, given in self._waiting
        ]
        return self._gone + self._followed

    def _follow(self, view: View) -> None:
        """Follow everyone, the nearest first: what stands behind one of them is hidden, and not looked for."""
        expected = [(one.expect(each, view), each) for each in self._followed]
        taken: list[Array] = []  # boxes
        for where, target in sorted(expected, key=lambda pair: pair[0].depth):
            own = box_of(where.quad)
            hidden = max((covered(own, box) for box in taken), default=0.0) if np.isfinite(own).all() else 0.0
            one.follow(target, view, where, hidden)
            taken.append(target.looks[-1].box)

    def _begin_given(self, view: View) -> None:
        while self._waiting and self._waiting[0][1].frame <= view.frame:
            identity, given = self._waiting.pop(0)
            new = one.start(identity, self._head, self._config, self._models, view, given.left, True)
            if new is None:
                self.missed.append(f"target {identity} of init.yaml stands above the horizon at frame {view.frame}")
            else:
                self._followed.append(new)

    def _begin_found(self, found: Sequence[Array], since: Sequence[View]) -> None:
        """Begin targets in quads (4, 2) px of the first of some views, and follow them through the others.

        Who was lost or away goes on.
        """
        for quad in found:
            old, own = self._known(quad, since[0])
            identity = self._next_id if old is None else old.id
            new = one.start(identity, self._head, self._config, self._models, since[0], own, False)
            if new is None:
                continue
            if old is None:
                self._next_id += 1
            else:
                new.earlier, new.size, new.colours = old, old.size, old.colours
                for group in (self._gone, self._followed):
                    group[:] = [other for other in group if other is not old]
            for view in since[1:]:
                one.follow(new, view, one.expect(new, view), 0.0)
            for view in since:
                view.known.append(new.looks[-1].box)
            self._followed.append(new)

    def _known(self, quad: Array, view: View) -> tuple[Target | None, Array]:
        """Who of those that are lost or away is in a quad (4, 2), and where; else nobody, and the quad as it is."""
        lost = [each for each in self._followed if view.t - each.last_seen > COASTED_S]
        for old in sorted([*lost, *self._gone], key=lambda each: -each.last_seen):
            again = one.found_again(old, view, quad)
            if again is not None:
                return old, again
        return None, quad

    def _over(self, target: Target, t: float) -> bool:
        """Whether a track ends here, and why."""
        middle = target.looks[-1].box[:2] + target.looks[-1].box[2:] / 2
        if t - target.last_seen > self._config.life.max_coast_s:
            target.ended_by = "lost"
        elif not np.isfinite(middle).all() or np.any(middle < 0) or np.any(middle > self._size):
            target.ended_by = "left"
        return bool(target.ended_by)
