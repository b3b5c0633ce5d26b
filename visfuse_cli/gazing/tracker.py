"""Every target before a pan-tilt head, frame by frame: followed, ended, begun where named or found by normal flow."""

from __future__ import annotations

from collections.abc import Sequence

from visfuse_cli.gazing import target as one
from visfuse_cli.gazing.find import KNOWN, Finder, View, shared
from visfuse_cli.gazing.head import Head
from visfuse_cli.gazing.models import Courses
from visfuse_cli.gazing.target import Expected, Target
from visfuse_cli.moving.pursuit import Pursuit, Stage
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, GivenTarget, Image
from visfuse_cli.vision import patches
from visfuse_cli.vision.boxes import box_of

YOUNG_S = 1.0  # s for which a target may turn out to have been begun in part


class Tracker(Pursuit[Target, View, Expected, Array]):
    """Follows all targets; `step` for every straight picture, `finish` after the last."""

    unbegun = "stands above the horizon"

    def __init__(
        self, head: Head, config: ImmConfig, size: tuple[int, int], given: Sequence[GivenTarget], stage: Stage
    ) -> None:
        super().__init__(config, size, given)
        self._head, self._stage = head, stage
        self._models, self._finder = Courses(config.filter), Finder(head, config)

    def step(self, picture: Image, frame: int, t: float, gaze: Array) -> list[Target]:
        """One picture further; returns those that nobody follows any more."""
        with self._stage("pyramids"):
            view = View(frame, t, gaze, picture, patches.pyramid(picture), [])
        with self._stage("filter"):
            self._follow(view)
        self._part(t)
        view.known.extend((each.seen[-1]["box"], each.wider) for each in self._followed)
        self._begin_given(view)
        if self._wanted(t):
            with self._stage("newcomers"):
                found, since = self._finder.look(view)
                self._begin_found(found, since)
        else:
            self._finder.rest()
        return self._forgotten(t)

    def _expect(self, target: Target, view: View) -> Expected:
        return one.expect(target, view)

    def _seek(self, target: Target, view: View, where: Expected, hidden: float) -> None:
        one.follow(target, view, where, hidden)

    def _named(self, identity: int, given: GivenTarget, view: View) -> Target | None:
        return one.start(identity, self._head, self._config, self._models, view, given.left, True)

    def _again(self, target: Target, view: View, found: Array) -> Array | None:
        return one.found_again(target, view, found)

    def _begin_found(self, found: Sequence[Array], since: Sequence[View]) -> None:
        """Begin targets in quads (4, 2) px of the first of some views, and follow them through the others.

        Who was lost or away goes on; what was begun in part is begun again as a whole.
        """
        for quad in found:
            part, fresh = self._part_of(quad, since[0])
            old, own = (None, None) if part is not None else self._known(since[0], quad)
            if not fresh or (self._given and old is None):
                continue  # who is followed was said, or is seen well for long
            identity, given = (old.id, old.given) if old is not None else (self._next_id, False)
            new = one.start(
                identity, self._head, self._config, self._models, since[0], quad if own is None else own, given
            )
            if new is None:
                continue
            if part is not None:
                new.id = part.id
                self._followed[self._followed.index(part)] = new
            else:
                self._take(new, old)
            for view in since[1:]:
                one.follow(new, view, one.expect(new, view), 0.0)
            for view in since:
                view.known.append((new.seen[-1]["box"], new.wider))

    def _part_of(self, quad: Array, view: View) -> tuple[Target | None, bool]:
        """Who is followed in a part of a quad (4, 2) of a view, if anybody, and whether the quad is to be begun."""
        for each in self._followed:
            box = each.box_at(view.frame)
            if box is not None and shared(box, box_of(quad)) > KNOWN:
                return each, not each.given and view.t - each.seen[0]["t"] < YOUNG_S
        return None, True
