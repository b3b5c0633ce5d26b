"""The watch over a camera that should not move: every frame laid back to where the camera rests, and a report."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from visfuse_cli.records import Array, Frame, Image
from visfuse_cli.vision.exposure import Exposure, levelled
from visfuse_cli.vision.steady import STILL_PX, Steady, moved

QUIET_FRAMES, LOOK_EVERY = 25, 5  # after so many frames without a change only every so many are looked at
SETTLED_S = 2.0  # a camera that was knocked stays where it is for longer than a gust lasts
MOVED_PX, MOVED_SHAKES = 3.0, 3.0  # px, and times the shake, that it must have moved
STAYS = 0.8  # share of that time
MAD = 1.4826  # standard deviations in a median absolute deviation
WORTH_TELLING_PX = 0.5  # of shake


class CameraWatch:
    """Registers the frames of one clip to the scene at rest and keeps a log of where the camera looked."""

    def __init__(self, empty: Image) -> None:
        self.log = CameraLog()
        self._steady, self._exposure = Steady(empty), Exposure(empty)
        self._motion = np.eye(3)
        self._unchanged = 0  # frames
        self._lost = False

    def steadied(self, frame: Frame) -> Frame | None:
        """The frame as the camera at rest sees it, as bright as there, None where the scene cannot be found in it."""
        frame = self._levelled(frame)
        if self._unchanged < QUIET_FRAMES or frame.index % LOOK_EVERY == 0 or self._lost:
            found = self._steady.register(frame.image)
            self._lost = found is None
            if found is None:
                self._unchanged = 0
                self.log.miss(frame.t)
                return None
            quiet = self._steady.shift(found @ np.linalg.inv(self._motion)) < 2 * STILL_PX
            self._unchanged = self._unchanged + 1 if quiet else 0
            self._motion = found
            self.log.note(frame.t, moved(found, self._steady.middle) - self._steady.middle)
        if self._steady.shift(self._motion) < STILL_PX:
            return frame
        return replace(frame, image=self._steady.laid_back(frame.image, self._motion), image_from_rest=self._motion)

    def _levelled(self, frame: Frame) -> Frame:
        gain = self._exposure.gain(frame.image)
        self.log.note_gain(gain)
        image = levelled(frame.image, gain)
        return frame if image is frame.image else replace(frame, image=image)


class CameraLog:
    """What a camera did that should not move: its shake, where it was moved, and when the scene was not found."""

    def __init__(self) -> None:
        self.moves: list[dict[str, float]] = []
        self.lost: list[list[float]] = []  # first and last t (s) of stretches in which the scene was not found
        self._gap: list[float] | None = None  # the present one
        self._gains = 1.0, 1.0  # the least and the largest there were
        self._recent: deque[tuple[float, Array]] = deque()  # t and shift (2,) px of the middle
        self._squares, self._count = 0.0, 0
        self._place = np.zeros(2)  # px: where the middle was when it was last said to have moved

    def note_gain(self, gain: Array) -> None:
        """Note by how much (3,) a picture was made brighter."""
        self._gains = min(self._gains[0], float(gain.min())), max(self._gains[1], float(gain.max()))

    def miss(self, t: float) -> None:
        """Note that the scene was not found at t (s)."""
        if self._gap is None:
            self._gap = [t, t]
            self.lost.append(self._gap)
        self._gap[1] = t

    def note(self, t: float, shift: Array) -> None:
        """Note that the scene was found at t (s), its middle shifted (2,) px."""
        self._gap = None
        self._recent.append((t, shift))
        while self._recent[0][0] < t - SETTLED_S:
            self._recent.popleft()
        recent = np.array([each for _, each in self._recent])
        place = np.median(recent, axis=0)
        # of the middle, not of the mean: a knock is no shake
        self._squares += float(np.sum((MAD * np.median(np.abs(recent - place), axis=0)) ** 2)) / 2
        self._count += 1
        shake = np.sqrt(self._squares / self._count)
        way = float(np.hypot(*(place - self._place)))
        there = np.hypot(*(recent - place).T) < way / 2
        if (
            way > max(MOVED_PX, MOVED_SHAKES * shake)
            and there.mean() > STAYS
            and t - self._recent[0][0] > 0.8 * SETTLED_S
        ):
            self.moves.append({"t": round(self._recent[int(np.argmax(there))][0], 3), "px": round(way, 2)})
            self._place = place

    def was_lost(self, t: float) -> bool:
        """Whether the scene could not be found at t (s)."""
        return any(first <= t <= last for first, last in self.lost)

    def last_move(self, t: float) -> dict[str, float] | None:
        """When (s) and how far (px) the camera was moved last before t (s); None where it was not."""
        return next((move for move in reversed(self.moves) if move["t"] <= t), None)

    def report(self) -> dict[str, Any]:
        """What run.json says about the camera: shake (px rms), moves, stretches (s) not measured, range of the gain."""
        shake = float(np.sqrt(self._squares / self._count)) if self._count else 0.0
        return {
            "shake_px": round(shake, 2),
            "moves": self.moves,
            "not_measured": self.lost,
            "exposure_gain": [round(gain, 3) for gain in self._gains],
        }

    def warnings(self, clip: str) -> list[str]:
        """The same, as sentences."""
        shake, said = self.report()["shake_px"], []
        if shake > WORTH_TELLING_PX:
            said.append(f"{clip}: the camera shakes by {shake:.1f} px; compensated")
        if self.moves:
            first, largest = self.moves[0]["t"], max(move["px"] for move in self.moves)
            said.append(
                f"{clip}: the camera moved, first at {first:.1f} s, by up to {largest:.1f} px; "
                "registered to where it was at rest, but calibrate again"
            )
        if self.lost:
            first, seconds = self.lost[0][0], sum(end - begin for begin, end in self.lost)
            said.append(
                f"{clip}: the scene could not be recognised for {seconds:.2f} s, first at {first:.2f} s; "
                "not measured there"
            )
        return said


class Motions:
    """Where the camera looked in the frames in which it was not at rest; they come in order, 44 bytes each."""

    def __init__(self) -> None:
        self._frames, self._entries = array("q"), array("f")  # and 9 numbers for each

    def note(self, frame: Frame) -> None:
        """Remember where the camera looked in a frame."""
        if frame.image_from_rest is not None:
            self._frames.append(frame.index)
            self._entries.extend(frame.image_from_rest.ravel())

    def image_from_rest(self, frame: int) -> Array | None:
        """Where (3, 3) px the camera looked in a frame, None where it was at rest."""
        k = bisect_left(self._frames, frame)
        if k == len(self._frames) or self._frames[k] != frame:
            return None
        return np.array(self._entries[9 * k : 9 * k + 9], dtype=float).reshape(3, 3)
