"""Vehicles that nobody named: what moves in the left view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.records import Array, Image, StereoRig
from visfuse_cli.vision.background import FOREGROUND, Background

OVERLAP = 0.2  # share of a region that a vehicle which is followed already may hold
LEAST_MOVE = 0.02  # of its size, that a region must have moved or grown
EDGE_PX = 1.5  # of a region: how far its sides may be off
DENSE = 0.6  # share of the fullest row or column
MEMORY_S, SHADOW = 60.0, 0.5


@dataclass(slots=True)
class _Candidate:
    box: Array  # [u0, v0, u1, v1] px
    first: Array
    first_t: float
    seen: int = 1


@dataclass(frozen=True, slots=True)
class Found:
    """A region that moves: its left quad (4, 2) px, how fast its middle moves (2,) px/s, its growth (1/s), and the
    deviation of that.
    """

    quad: Array
    motion: Array
    growth: float
    growth_sigma: float

    def velocity(self, rig: StereoRig, place: Array) -> Array:
        """Velocity (3,) m/s of what stands at a place (3,) m."""
        away = -self.growth * place[2]
        across = self.motion / np.diag(rig.left.K)[:2] * place[2]
        return np.array([across[0], across[1], 0.0]) + away * place / place[2]


class Finder:
    """Looks at each left picture; `empty` (H, W, 3) is the scene without vehicles."""

    def __init__(self, rig: StereoRig, empty: Image, config: StereoConfig) -> None:
        self._rig, self._config = rig, config
        self._background = Background("mog2", config.detection.threshold, SHADOW, MEMORY_S)
        self._background.start(empty)
        self._candidates: list[_Candidate] = []
        self.regions: list[Array] = []  # boxes [u0, v0, u1, v1] px of what moves in the latest picture

    def around(self, quad: Array) -> Array | None:
        """The quad (4, 2) of the one region of the latest picture that holds a quad (4, 2), or None."""
        own = np.concatenate([quad.min(axis=0), quad.max(axis=0)])
        near = [box for box in self.regions if _shared(box, own) > OVERLAP]
        return self._quad(near[0]) if len(near) == 1 else None

    def look(self, picture: Image, t: float, known: list[Array]) -> list[Found]:
        """Regions that have moved for some frames, away from quads that are `known`."""
        self.regions = boxes = self._regions(picture)
        held = [np.concatenate([quad.min(axis=0), quad.max(axis=0)]) for quad in known]
        boxes = [box for box in boxes if not any(_shared(box, other) > OVERLAP for other in held)]
        self._background.learn(picture, t, [_corners(box) for box in [*boxes, *held]])
        kept = []
        for box in boxes:
            before = next((c for c in self._candidates if _near(c.box, box)), None)
            if before is None:
                kept.append(_Candidate(box, box, t))
            else:
                kept.append(_Candidate(box, before.first, before.first_t, before.seen + 1))
        ready = [c for c in kept if c.seen >= self._config.detection.confirm_frames + 1 and _moved(c)]
        self._candidates = [c for c in kept if not any(c is other for other in ready)]
        return [self._found(c, t) for c in ready]

    def _regions(self, picture: Image) -> list[Array]:
        """Boxes [u0, v0, u1, v1] of what moves and lies whole in the picture."""
        mask = cv2.compare(self._background.detect(picture), FOREGROUND, cv2.CMP_EQ)
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        reach = max(3, round(picture.shape[0] / 100) | 1)
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((reach, reach), np.uint8))
        # What comes straight at the camera hides its first place from the empty scene: it shows as a ring.
        rims, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        mask = cv2.drawContours(np.zeros_like(mask), rims, -1, 255, cv2.FILLED)
        _, _, blobs, _ = cv2.connectedComponentsWithStats(np.asarray(mask, np.uint8))
        high, wide = picture.shape[:2]
        least = self._config.detection.smallest
        found = []
        for x, y, w, h, area in blobs[1:]:
            whole = x > 1 and y > 1 and x + w < wide - 1 and y + h < high - 1
            if min(w, h) >= least and area > 0.4 * w * h and whole:
                box = _dense(mask[y : y + h, x : x + w]) + [x, y, x, y]
                if np.all(box[2:] - box[:2] >= least):
                    found.append(box)
        return found

    def _found(self, candidate: _Candidate, t: float) -> Found:
        dt = t - candidate.first_t
        old, new = candidate.first, candidate.box
        moved = ((new[:2] + new[2:]) - (old[:2] + old[2:])) / 2
        grown = 0.5 * float(np.log(np.prod(new[2:] - new[:2]) / np.prod(old[2:] - old[:2])))
        doubt = EDGE_PX / float(np.sqrt(np.prod(old[2:] - old[:2])))
        return Found(self._quad(new), moved / dt, grown / dt, doubt / dt)

    def _quad(self, box: Array) -> Array:
        """The corners of a region less its rim, where background shows."""
        share = self._config.detection.margin
        rim = share * (box[2:] - box[:2])
        return _corners(box + np.concatenate([rim, -rim]))


def _dense(mask: Image) -> Array:
    """The box [u0, v0, u1, v1] of those rows and columns of a region that are well filled: without shadows' ends."""
    ends = []
    for axis in (0, 1):
        filled = np.count_nonzero(mask, axis=axis)
        good = np.flatnonzero(filled >= DENSE * filled.max())
        ends.append((good[0] - 0.5, good[-1] + 0.5))
    return np.array([ends[0][0], ends[1][0], ends[0][1], ends[1][1]])


def _corners(box: Array) -> Array:
    u0, v0, u1, v1 = box
    return np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])


def _shared(box: Array, other: Array) -> float:
    inner = np.clip(np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2]), 0, None)
    return float(np.prod(inner) / min(np.prod(box[2:] - box[:2]), np.prod(other[2:] - other[:2])))


def _near(one: Array, other: Array) -> bool:
    """Whether two boxes may be one vehicle in two frames."""
    size = np.minimum(one[2:] - one[:2], other[2:] - other[:2])
    apart = np.abs((one[:2] + one[2:]) / 2 - (other[:2] + other[2:]) / 2)
    ratio = (one[2:] - one[:2]) / (other[2:] - other[:2])
    return bool(np.all(apart < 1.5 * size) and np.all((ratio > 0.6) & (ratio < 1.7)))


def _moved(candidate: _Candidate) -> bool:
    size = candidate.first[2:] - candidate.first[:2]
    return bool(np.abs(candidate.box - candidate.first).max() > max(2.0, LEAST_MOVE * float(size.max())))
