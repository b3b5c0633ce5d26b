"""What each frame says to the tracker: where it differs from the adaptive background, or boxes from outside."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from pydantic import Field

from visfuse_cli.config import Section
from visfuse_cli.maths.homography import apply
from visfuse_cli.records import Array, Frame, GroundCamera, Image
from visfuse_cli.tracking.elsewhere import HandOver, at_once
from visfuse_cli.tracking.evidence import Boxes, BoxEvidence, Evidence, LabelEvidence
from visfuse_cli.tracking.ground import GroundTracker
from visfuse_cli.tracking.sun import Shade, Sun, shadow_picture
from visfuse_cli.tracking.zones import Region
from visfuse_cli.vision import contour, wireframe
from visfuse_cli.vision import regions as region_tools
from visfuse_cli.vision.background import FOREGROUND, Background
from visfuse_cli.vision.cast_shadows import Darkness, lightness, without_soft_shadows
from visfuse_cli.vision.points import Corners, MovingPoints
from visfuse_cli.vision.regions import Cleaned
from visfuse_cli.vision.steady import moved

LEARNING = 3  # frames that may still wait to be learnt
SETTLED = 12  # frames after which a track's size is known well enough to tell its shadow


class BackgroundSettings(Section):
    """The adaptive background."""

    model: Literal["mog2", "knn", "kalman"] = Field(
        "mog2", description="mog2: mixture of Gaussians; knn: nearest neighbours; kalman: adaptive Kalman filters"
    )
    threshold: float = Field(16.0, gt=0, le=1000, description="squared distance (variances) of a foreground pixel")
    memory_s: float = Field(60.0, gt=0, le=36000, description="s: how long the background remembers")
    shadow_ratio: float = Field(0.45, gt=0, lt=1, description="darkest a shadow may be, as a share of the lit ground")
    warmup_s: float = Field(20.0, ge=0, le=600, description="s: the empty scene is found in this much footage")


class RegionSettings(Section):
    """Cleaning of the foreground, in metres at the scale of the ground."""

    gap: float = Field(0.3, ge=0, le=5, description="m: gaps up to this size are closed")
    speck: float = Field(0.12, ge=0, le=5, description="m: specks below this size are removed")


class Detector(Protocol):
    """A source of evidence, asked frame by frame."""

    def foresee(self, frame: Frame) -> None:
        """Begin to look at the frame that comes after those foreseen before, while another is thought about."""

    def evidence(self, frame: Frame, expected: Boxes) -> Evidence:
        """What the first of the frames foreseen says, in which boxes are expected."""

    def learn(self, frame: Frame, tracker: GroundTracker) -> None:
        """Adapt to a frame, except where something is followed."""

    def report(self) -> dict[str, Any] | None:
        """Where the sun stands, where that was found."""


@dataclass(frozen=True, slots=True)
class _Seen:
    """A frame against the background (H, W): in grey, and how light it is.

    raw: its labels; hard: without shadows that fade into the ground, of which the sun casts none; labels: what is
    thought of them; cleaned: these without specks; sunny: whether shadows are told by their darkness.
    """

    grey: Image
    light: Image
    raw: Image
    hard: Image
    labels: Image
    cleaned: Cleaned
    sunny: bool


_Foreseen = tuple[Callable[[], _Seen], Callable[[], Corners] | None]  # what a frame shows and its corners, once asked


class MovingRegions:
    """What differs from the adaptive background, which begins as a picture (H, W, 3) of the empty scene."""

    def __init__(
        self,
        camera: GroundCamera,
        background: BackgroundSettings,
        cleaning: RegionSettings,
        smallest_m: float,
        empty: Image,
        region: Region | None = None,
        corners: MovingPoints | None = None,
        compare: HandOver = at_once,
        follow: HandOver = at_once,
    ) -> None:
        self._camera, self._corners = camera, corners
        self._compare, self._follow = compare, follow
        self._cleaning = cleaning.gap, cleaning.speck, smallest_m
        self._bands = region_tools.bands(camera)
        self._background = Background(
            background.model, background.threshold, background.shadow_ratio, background.memory_s
        )
        self._background.start(empty)
        self._empty = empty  # the scene as it was learnt a few frames ago: nobody waits for what is being learnt
        self._watched = None if region is None else region.picture(camera)
        self._sun, self._shade = Sun(camera), Shade(background.shadow_ratio)
        self._foreseen: deque[_Foreseen] = deque()
        self._learning: deque[Callable[[], Image]] = deque()
        self._darkness = Darkness()
        self._seen: _Seen | None = None  # the frame that evidence was given of
        self._labels = np.zeros((0, 0), np.uint8)

    def foresee(self, frame: Frame) -> None:
        seen, corners = self._compare(lambda: self._see(frame.image)), self._corners
        if corners is None:
            self._foreseen.append((seen, None))
        else:
            followed = self._follow(lambda: corners.follow(seen().grey, frame.t, paint_of(seen().labels)))
            self._foreseen.append((seen, followed))

    def _see(self, image: Image) -> _Seen:
        raw = self._background.detect(image)
        grey = grey_of(image)
        light = lightness(grey, grey_of(self._background.picture))
        hard = raw if self._darkness.known else without_soft_shadows(raw, light)
        labels = self._darkness.told(hard, light)
        if self._watched is not None:
            labels = np.asarray(cv2.bitwise_and(labels, self._watched), dtype=np.uint8)
        return _Seen(grey, light, raw, hard, labels, self._clean(labels), self._darkness.known)

    def evidence(self, frame: Frame, expected: Boxes) -> Evidence:
        awaited, corners = self._foreseen.popleft()
        seen = awaited()
        self._seen, labels, cleaned = seen, seen.labels, seen.cleaned
        if self._sun.shadow is not None and self._shade.needed and len(expected[0]):
            where = shadow_picture(self._camera, *expected, self._sun.shadow.per_metre)
            labels = self._shade.cut(labels, frame.image, self._empty, where)
            if labels is not seen.labels:
                cleaned = self._clean(labels)
        self._labels = labels
        return LabelEvidence(labels, self._camera, self._bands, *self._cleaning, cleaned, corners, seen.sunny)

    def _clean(self, labels: Image) -> Cleaned:
        return region_tools.cleaned(labels, self._bands, self._cleaning[1])

    def learn(self, frame: Frame, tracker: GroundTracker) -> None:
        pose, size = tracker.boxes()
        settled = np.array([len(t.samples) >= SETTLED and t.samples[-1].measured for t in tracker.tracks], dtype=bool)
        self._sun.look(frame.t, self._labels, pose, size, settled, [track.id for track in tracker.tracks])
        followed, seen = partial(self._outlines, pose, size), self._seen
        assert seen is not None
        self._learning.append(self._compare(lambda: self._learnt(frame, followed, seen)))
        if len(self._learning) > LEARNING:
            self._empty = self._learning.popleft()()

    def _learnt(self, frame: Frame, followed: Callable[[], Iterator[Array]], seen: _Seen) -> Image:
        self._background.learn(frame.image, frame.t, followed(), seen.raw)
        self._darkness.learn(seen.hard, seen.light, followed())
        return self._background.picture

    def _outlines(self, pose: Array, size: Array) -> Iterator[Array]:
        """Outlines (k, 2) px of N boxes as the footage shows them, found when they are asked for: few frames are."""
        for hull in contour.hulls_of(self._camera, wireframe.projected(self._camera, pose, size)):
            if len(hull):
                yield hull

    def report(self) -> dict[str, Any] | None:
        while self._learning:
            self._learning.popleft()()
        return None if self._sun.shadow is None else self._sun.shadow.report()


def grey_of(image: Image) -> Image:
    """A picture (H, W, 3) in grey (H, W)."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def paint_of(labels: Image) -> Image:
    """Mask (H, W), 255 where something differs from the background that is no shadow."""
    return np.asarray(cv2.compare(labels, FOREGROUND, cv2.CMP_EQ), dtype=np.uint8)


class Detections:
    """Upright boxes from an external detector: frame -> (n, 5) x, y, w, h px and score."""

    def __init__(self, camera: GroundCamera, boxes: dict[int, Array], region: Region | None = None) -> None:
        self._camera, self._boxes, self._region = camera, boxes, region

    def foresee(self, frame: Frame) -> None:
        """Boxes from outside are there already."""

    def evidence(self, frame: Frame, expected: Boxes) -> Evidence:
        rows = self._boxes.get(frame.index, np.zeros((0, 5)))
        if frame.image_from_rest is not None:
            middle = np.asarray(rows[:, :2] + rows[:, 2:4] / 2, dtype=float)
            rows = rows.copy()
            rows[:, :2] += moved(np.asarray(np.linalg.inv(frame.image_from_rest), dtype=float), middle) - middle
        found = [region_tools.from_box(row[:4], row[4], self._camera.image_size) for row in rows]
        lens = self._camera.ground.lens
        if lens is not None:
            found = [region_tools.undistorted(region, lens) for region in found]
        if self._region is not None and found:
            feet = np.array([each.box[:2] + each.box[2:] * [0.5, 1.0] for each in found])
            near = self._region.near(apply(self._camera.ground.ground_from_image, feet))
            found = [each for each, kept in zip(found, near, strict=True) if kept]
        return BoxEvidence(found, self._camera)

    def learn(self, frame: Frame, tracker: GroundTracker) -> None:
        """Boxes from outside need no background."""

    def report(self) -> dict[str, Any] | None:
        return None
