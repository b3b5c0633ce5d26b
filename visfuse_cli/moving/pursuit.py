"""Who is waited for, followed, or away but remembered: what both kinds of tracker do with their targets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Generic, Protocol, Self, TypeVar

import numpy as np

from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, GivenTarget
from visfuse_cli.vision.boxes import covered
from visfuse_cli.vision.looks import COASTED_S, HIDDEN

Stage = Callable[[str], AbstractContextManager[None]]


class Seen(Protocol):
    """A picture, or a pair: its number and time (s)."""

    @property
    def frame(self) -> int: ...

    @property
    def t(self) -> float: ...


class Thought(Protocol):
    """Where a target is thought to be: its box [x, y, w, h] px, none out of sight, and its depth m."""

    @property
    def box(self) -> Array | None: ...

    @property
    def depth(self) -> float: ...


class Pursued(Protocol):
    """What a target must tell; `box` is the latest one, `measured` whether it was seen there."""

    id: int
    given: bool
    last_seen: float
    ended_by: str
    size: Array
    colours: Array
    earlier: Self | None

    @property
    def box(self) -> Array | None: ...

    @property
    def measured(self) -> bool: ...


T = TypeVar("T", bound=Pursued)
V = TypeVar("V", bound=Seen)
W = TypeVar("W", bound=Thought)
F = TypeVar("F")


class Pursuit(ABC, Generic[T, V, W, F]):
    """Targets T through views V, each thought to be somewhere W, begun where named or found F."""

    unbegun = ""  # why a named target could not be begun

    def __init__(self, config: ImmConfig, size: tuple[int, int], given: Sequence[GivenTarget]) -> None:
        self._config, self._size, self._given = config, size, bool(given)
        self._waiting = sorted(enumerate(given, start=1), key=lambda pair: pair[1].frame)
        self._followed: list[T] = []
        self._gone: list[T] = []  # but remembered: they may come back
        self._next_id = 1
        self.missed: list[str] = []  # what was to be begun and could not be

    @abstractmethod
    def _expect(self, target: T, view: V) -> W:
        """Where the target is thought to be."""

    @abstractmethod
    def _seek(self, target: T, view: V, where: W, hidden: float) -> None:
        """Look for it there; others hide a share of it."""

    @abstractmethod
    def _named(self, identity: int, given: GivenTarget, view: V) -> T | None:
        """A target of init.yaml, begun."""

    @abstractmethod
    def _again(self, target: T, view: V, found: F) -> Array | None:
        """The quad (4, 2) px of a target that was lost or away in what was found; None where it is not it."""

    def finish(self) -> list[T]:
        """Those that were followed to the end, or waited for."""
        for each in self._followed:
            each.ended_by = "end of footage"
        self.missed += [
            f"target {identity} of init.yaml begins at frame {given.frame}, which the footage does not have"
            for identity, given in self._waiting
        ]
        return self._gone + self._followed

    def _follow(self, view: V) -> None:
        """Follow everyone, the nearest first: what stands behind one of them is hidden, and not looked for."""
        expected = [(self._expect(each, view), each) for each in self._followed]
        taken: list[Array] = []  # boxes
        for where, target in sorted(expected, key=lambda pair: pair[0].depth):
            own = where.box
            hidden = max((covered(own, box) for box in taken), default=0.0) if own is not None else 0.0
            self._seek(target, view, where, hidden)
            if target.box is not None and (target.measured or hidden < HIDDEN):
                taken.append(target.box)

    def _begin_given(self, view: V) -> None:
        while self._waiting and self._waiting[0][1].frame <= view.frame:
            identity, given = self._waiting.pop(0)
            new = self._named(identity, given, view)
            if new is None:
                self.missed.append(f"target {identity} of init.yaml {self.unbegun} at frame {view.frame}")
            else:
                self._followed.append(new)

    def _wanted(self, t: float) -> bool:
        """Whether what moves is looked for: where targets were named, only as long as one of them is lost or away."""
        return not self._given or bool(self._gone) or bool(self._lost(t))

    def _known(self, view: V, found: F) -> tuple[T | None, Array | None]:
        """Who of those that are lost or away was found, and its quad (4, 2) px; else nobody."""
        for old in sorted([*self._lost(view.t), *self._gone], key=lambda each: -each.last_seen):
            quad = self._again(old, view, found)
            if quad is not None:
                return old, quad
        return None, None

    def _take(self, new: T, old: T | None) -> None:
        """Follow a target that was begun, as a new one or as the old one that it is."""
        if old is None:
            self._next_id += 1
        else:
            new.earlier, new.size, new.colours = old, old.size, old.colours
            for group in (self._gone, self._followed):
                group[:] = [other for other in group if other is not old]
        self._followed.append(new)

    def _lost(self, t: float) -> list[T]:
        return [each for each in self._followed if t - each.last_seen > COASTED_S]

    def _part(self, t: float) -> None:
        """Part with those whose track ends here."""
        self._gone += [each for each in self._followed if self._over(each, t)]
        self._followed = [each for each in self._followed if not each.ended_by]

    def _forgotten(self, t: float) -> list[T]:
        """Those that nobody waits for any more."""
        memory = self._config.life.memory_s
        over = [each for each in self._gone if t - each.last_seen > memory]
        self._gone = [each for each in self._gone if t - each.last_seen <= memory]
        return over

    def _over(self, target: T, t: float) -> bool:
        """Whether a track ends here, and why."""
        box = target.box
        if t - target.last_seen > self._config.life.max_coast_s:
            target.ended_by = "lost"
        elif box is None or np.any(box[:2] + box[2:] / 2 < 0) or np.any(box[:2] + box[2:] / 2 > self._size):
            target.ended_by = "left"
        return bool(target.ended_by)
