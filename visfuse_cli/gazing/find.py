"""What moves by itself before a head that turns: normal flow that the turning leaves over, grown to regions."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visfuse_cli.gazing.head import Head
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, Image
from visfuse_cli.vision import normal_flow, patches
from visfuse_cli.vision.patches import Grey

GAP_S = 0.1  # between the pictures that are compared: what is slow has then moved, too
ALIKE = 0.4  # overlap with the region of the frame before
JOINED = 0.5  # of the narrower one's width: what lies in line, and no further than the higher one is high, is one thing
KNOWN = 0.2  # overlap with what is followed already
LARGER, HELD = 1.4, 0.8  # times the area of what is followed, and its share inside: the whole of a part
WIDER, UNCUT = 1.6, 3.0  # times its width, at most: two side by side are wider; and of what the picture's side cut off


@dataclass(frozen=True, slots=True)
class View:
    """One frame: its number, time, gaze, picture, grey pyramid, and what was followed in it.

    That is boxes [x, y, w, h], each with how many times wider the whole of it may be.
    """

    frame: int
    t: float
    gaze: Array
    picture: Image
    levels: list[Grey]
    known: list[tuple[Array, float]]

    @property
    def grey(self) -> Image:
        """The picture itself (H, W)."""
        return np.asarray(self.levels[0], np.uint8)


class Finder:
    """Finds regions that move: each picture is compared with those GAP_S before and after, so that only what is at its
    place in the picture itself stands out in both.
    """

    def __init__(self, head: Head, config: ImmConfig) -> None:
        self._head, self._config = head, config
        self._views: deque[View] = deque()
        self._candidates: list[list[Array]] = []  # of each, its boxes [u0, v0, u1, v1] px so far

    def rest(self) -> None:
        """Nothing is looked for in this picture."""
        self._views.clear()
        self._candidates = []

    def look(self, view: View) -> tuple[list[Array], list[View]]:
        """Quads (4, 2) px of what moved for some frames and is not followed, or in part; the views from theirs on."""
        views = self._views
        views.append(view)
        middle = next((k for k, each in enumerate(views) if view.t - each.t <= GAP_S), len(views) - 1)
        middle = min(middle, len(views) - 2)
        first = next((k for k in range(middle, -1, -1) if views[middle].t - views[k].t >= GAP_S), None)
        if first is None or middle < 1:
            return [], []
        for _ in range(first):
            views.popleft()
        middle -= first
        return self._confirmed(self._regions(views[0], views[middle], view), views[middle].known), list(views)[middle:]

    def _regions(self, before: View, now: View, after: View) -> list[tuple[Array, int]]:
        """Boxes and areas of what has moved since the view before, and moves on to the view after."""
        settings = self._config.segmentation
        picture = now.grey
        least, gradient, known = np.full(picture.shape, np.inf), np.zeros(picture.shape), np.full_like(picture, 255)
        for other in (before, after):
            R = self._head.rotation(now.gaze).T @ self._head.rotation(other.gaze)
            turned, there = normal_flow.turned(other.grey, R, self._head.lens.K)
            flow, slope = normal_flow.normal_flow(turned, picture, self._config.flow.sigma)
            known = np.minimum(known, there)
            rest = normal_flow.steadied(flow, slope, known)
            least, gradient = np.minimum(least, np.linalg.norm(rest, axis=-1)), np.maximum(gradient, slope)
        return _whole(normal_flow.grown(least, gradient, known, settings.residual_px))

    def _confirmed(self, regions: Sequence[tuple[Array, int]], known: Sequence[tuple[Array, float]]) -> list[Array]:
        least = self._config.segmentation.smallest * self._views[0].grey.size
        held = [(np.append(box[:2], box[:2] + box[2:]), wider) for box, wider in known]
        kept, ready = [], []
        for box, area in regions:
            over = [each for each in held if _shared(box, each[0]) > KNOWN]
            if area < least or len(over) > 1 or any(not _outgrows(box, *each) for each in over):
                continue
            boxes = [*next((each for each in self._candidates if _shared(each[-1], box) > ALIKE), []), box]
            if len(boxes) < self._config.life.confirm_frames:
                kept.append(boxes)
                continue
            half = np.median([box[2:] - box[:2] for box in boxes], axis=0) / 2
            u0, v0, u1, v1 = np.concatenate([(box[:2] + box[2:]) / 2 - half, (box[:2] + box[2:]) / 2 + half])
            ready.append(np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]))
        self._candidates = kept
        return ready


def _whole(regions: list[tuple[Array, int]]) -> list[tuple[Array, int]]:
    """Regions one above the other joined to one thing: where it is plain there is no flow to grow through."""
    regions = list(regions)
    k = 0
    while k < len(regions):
        (one, area), other = regions[k], k + 1
        while other < len(regions) and not _above(one, regions[other][0]):
            other += 1
        if other == len(regions):
            k += 1
            continue
        more, its = regions.pop(other)
        regions[k] = np.append(np.minimum(one[:2], more[:2]), np.maximum(one[2:], more[2:])), area + its
        k = 0
    return regions


def _above(box: Array, other: Array) -> bool:
    across = min(box[2], other[2]) - max(box[0], other[0])
    gap = max(box[1], other[1]) - min(box[3], other[3])
    high = max(box[3] - box[1], other[3] - other[1])
    return bool(across > JOINED * min(box[2] - box[0], other[2] - other[0]) and gap < high)


def _outgrows(box: Array, held: Array, wider: float) -> bool:
    """Whether a box [u0, v0, u1, v1] is the whole, at most so many times wider, of what was followed in part."""
    (wide, high), (w, h) = box[2:] - box[:2], held[2:] - held[:2]
    inner = np.clip(np.minimum(box[2:], held[2:]) - np.maximum(box[:2], held[:2]), 0, None)
    return bool(wide * high > LARGER * w * h and wide < wider * w and np.prod(inner) > HELD * w * h)


def may_be_wider(quad: Array, wide: int) -> float:
    """How many times wider what was first seen in a quad (4, 2) px may turn out to be, in a picture so wide."""
    side = patches.side(quad)[0]
    return UNCUT if min(quad[:, 0].min(), wide - quad[:, 0].max()) < side else WIDER


def shared(box: Array, other: Array) -> float:
    """Overlap of two boxes [x, y, w, h], as a share of the smaller one."""
    return _shared(*(np.append(each[:2], each[:2] + each[2:]) for each in (box, other)))


def _shared(box: Array, other: Array) -> float:
    inner = np.clip(np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2]), 0, None)
    return float(np.prod(inner) / max(min(np.prod(box[2:] - box[:2]), np.prod(other[2:] - other[:2])), 1e-9))
