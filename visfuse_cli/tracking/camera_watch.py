"""The watch over a camera that should not move: every frame laid back to where the camera rests, and a report."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from visfuse_cli.records import Array, Frame
from visfuse_cli.vision.steady import STILL_PX, Steady, moved

QUIET_FRAMES, LOOK_EVERY = 25, 5  # after so many frames without a change only every so many are looked at
SETTLED_S = 2.0  # a camera that was knocked stays where it is for longer than a gust lasts
MOVED_PX, MOVED_SHAKES = 3.0, 3.0  # px, and times the shake, that it must have moved
WORTH_TELLING_PX = 0.5  # of shake


class CameraWatch:
    """Registers the frames of one clip to the scene at rest and remembers where the camera looked in each."""

    def __init__(self, steady: Steady) -> None:
        self._steady = steady
        self._motion = np.eye(3)
        self._unchanged = 0  # frames
        self._frames, self._entries = array("q"), array("f")  # frames in which it was elsewhere, and 9 numbers for each
        self._recent: deque[tuple[float, Array]] = deque()  # t and shift (2,) px of the middle
        self._squares, self._count = 0.0, 0
        self._place = np.zeros(2)  # px: where the middle was when it was last said to have moved
        self.moves: list[dict[str, float]] = []
        self.lost: list[list[float]] = []  # first and last t (s) of stretches in which the scene was not found
        self._gap: list[float] | None = None  # the present one

    def steadied(self, frame: Frame) -> Frame | None:
        """The frame as the camera at rest sees it, None where the scene cannot be found in it."""
        if self._unchanged < QUIET_FRAMES or frame.index % LOOK_EVERY == 0 or self._gap is not None:
            found = self._steady.register(frame.image)
            if found is None:
                self._miss(frame.t)
                return None
            self._gap = None
            quiet = self._steady.shift(found @ np.linalg.inv(self._motion)) < 2 * STILL_PX
            self._unchanged = self._unchanged + 1 if quiet else 0
            self._motion = found
            self._judge(frame.t)
        if self._steady.shift(self._motion) < STILL_PX:
            return frame
        self._frames.append(frame.index)
        self._entries.extend(self._motion.ravel())
        return replace(frame, image=self._steady.laid_back(frame.image, self._motion), image_from_rest=self._motion)

    def image_from_rest(self, frame: int) -> Array | None:
        """Where (3, 3) px the camera looked in a frame, None where it was at rest."""
        k = bisect_left(self._frames, frame)
        if k == len(self._frames) or self._frames[k] != frame:
            return None
        return np.array(self._entries[9 * k : 9 * k + 9], dtype=float).reshape(3, 3)

    def was_lost(self, t: float) -> bool:
        """Whether the scene could not be found at t (s)."""
        return any(first <= t <= last for first, last in self.lost)

    def report(self) -> dict[str, Any]:
        """What run.json says about the camera: shake (px rms), moves, stretches (s) that could not be measured."""
        shake = float(np.sqrt(self._squares / self._count)) if self._count else 0.0
        return {"shake_px": round(shake, 2), "moves": self.moves, "not_measured": self.lost}

    def warnings(self, clip: str) -> list[str]:
        """The same, as sentences."""
        report, said = self.report(), []
        if report["shake_px"] > WORTH_TELLING_PX:
            said.append(f"{clip}: the camera shakes by {report['shake_px']:.1f} px; compensated")
        said += [
            f"{clip}: the camera moved by {move['px']:.1f} px at {move['t']:.1f} s; "
            "registered to where it stood before, but calibrate again"
            for move in self.moves
        ]
        said += [
            f"{clip}: the scene could not be recognised from {first:.2f} to {last:.2f} s; not measured there"
            for first, last in report["not_measured"]
        ]
        return said

    def _miss(self, t: float) -> None:
        if self._gap is None:
            self._gap = [t, t]
            self.lost.append(self._gap)
        self._gap[1] = t
        self._unchanged = 0

    def _judge(self, t: float) -> None:
        shift = moved(self._motion, self._steady.middle) - self._steady.middle
        self._recent.append((t, shift))
        while self._recent[0][0] < t - SETTLED_S:
            self._recent.popleft()
        place = np.median([each for _, each in self._recent], axis=0)
        self._squares += float(np.sum((shift - place) ** 2)) / 2
        self._count += 1
        shake = np.sqrt(self._squares / self._count)
        settled = t - self._recent[0][0] > 0.8 * SETTLED_S
        way = float(np.hypot(*(place - self._place)))
        if settled and way > max(MOVED_PX, MOVED_SHAKES * shake):
            self.moves.append({"t": round(self._recent[0][0], 3), "px": round(way, 2)})
            self._place = place
