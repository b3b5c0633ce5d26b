"""The footage as it comes in: each frame steadied and compared with the background, before anybody thinks about it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Literal, Protocol

import cv2
import numpy as np
from pydantic import Field

from visfuse_cli.config import Section
from visfuse_cli.elsewhere import Enough, ahead
from visfuse_cli.records import Array, Boxes, Frame, GroundCamera, Image, TimeAudit
from visfuse_cli.threads import thread_cap
from visfuse_cli.tracking.camera_watch import CameraLog, CameraWatch
from visfuse_cli.vision import contour, wireframe
from visfuse_cli.vision import regions as region_tools
from visfuse_cli.vision.background import FOREGROUND, Background
from visfuse_cli.vision.cast_shadows import Darkness, lightness, without_soft_shadows
from visfuse_cli.vision.points import Corners, MovingPoints
from visfuse_cli.vision.regions import Cleaned


class BackgroundSettings(Section):
    """The adaptive background."""

    model: Literal["mog2", "knn", "kalman"] = Field(
        "mog2", description="mog2: mixture of Gaussians; knn: nearest neighbours; kalman: adaptive Kalman filters"
    )
    threshold: float = Field(16.0, gt=0, le=1000, description="squared distance (variances) of a foreground pixel")
    memory_s: float = Field(60.0, gt=0, le=36000, description="s: how long the background remembers")
    shadow_ratio: float = Field(0.45, gt=0, lt=1, description="darkest a shadow may be, as a share of the lit ground")
    warmup_s: float = Field(20.0, ge=0, le=600, description="s: the empty scene is found in this much footage")


@dataclass(frozen=True, slots=True)
class Comparing:
    """How frames are compared with the background: its settings, what is a speck (m), where to look (H, W) if not
    everywhere, and whether the corners of what moves are followed."""

    background: BackgroundSettings
    speck_m: float
    watched: Image | None
    corners: bool


@dataclass(frozen=True, slots=True)
class Change:
    """How a frame differs from the background: labels (H, W), the same without specks, and the corners of what moves.

    empty: the background (H, W, 3); sunny: whether shadows are told by their darkness.
    """

    labels: Image
    cleaned: Cleaned
    corners: Corners | None
    empty: Image
    sunny: bool


@dataclass(frozen=True, slots=True)
class Seen:
    """A frame as the camera at rest sees it, and how it differs from the background where it is compared with one."""

    frame: Frame
    change: Change | None


class Source(Protocol):
    """Footage that was opened."""

    def frames(self) -> Iterator[Frame]: ...

    def audit(self) -> TimeAudit: ...


def look_out(
    opened: Callable[[], AbstractContextManager[Source]], camera: GroundCamera, empty: Image, how: Comparing | None
) -> Generator[Seen | None, Boxes | None, tuple[TimeAudit, CameraLog]]:
    """Yield what is seen in each frame, None where the scene is not recognised, and be told what is followed in it.

    `empty` (H, W, 3) is the scene without its traffic. Returns what the times and the camera were like.
    """
    cv2.setNumThreads(thread_cap() or cv2.getNumberOfCPUs())
    watch = CameraWatch(empty)
    comparison = None if how is None else Comparison(camera, how, empty)
    with opened() as source:
        with ahead(lambda: map(watch.steadied, source.frames())) as frames:
            try:
                for frame in frames:
                    change = None if frame is None or comparison is None else comparison.look(frame)
                    followed = yield None if frame is None else Seen(frame, change)
                    if followed is not None and comparison is not None:
                        comparison.learn(followed)
            except Enough:
                pass
        return source.audit(), watch.log


class Comparison:
    """Compares frames with the adaptive background, which begins as a picture (H, W, 3) of the empty scene."""

    def __init__(self, camera: GroundCamera, how: Comparing, empty: Image) -> None:
        settings = how.background
        self._camera, self._speck, self._watched = camera, how.speck_m, how.watched
        self._bands = region_tools.bands(camera)
        self._background = Background(settings.model, settings.threshold, settings.shadow_ratio, settings.memory_s)
        self._background.start(empty)
        self._darkness = Darkness()
        self._corners = MovingPoints(camera) if how.corners else None
        self._waiting: deque[_Looked] = deque()  # frames that were looked at and not learnt yet

    def look(self, frame: Frame) -> Change:
        """Compare a frame."""
        raw = self._background.detect(frame.image)
        grey = _grey(frame.image)
        light = lightness(grey, self._background.grey)
        hard = raw if self._darkness.known else without_soft_shadows(raw, light)
        labels = self._darkness.told(hard, light)
        if self._watched is not None:
            labels = np.asarray(cv2.bitwise_and(labels, self._watched), dtype=np.uint8)
        corners = None
        if self._corners is not None:
            paint = np.asarray(cv2.compare(labels, FOREGROUND, cv2.CMP_EQ), dtype=np.uint8)
            corners = self._corners.follow(grey, frame.t, paint)
        self._waiting.append(_Looked(frame, raw, hard, light))
        cleaned = region_tools.cleaned(labels, self._bands, self._speck)
        return Change(labels, cleaned, corners, self._background.picture, self._darkness.known)

    def learn(self, followed: Boxes) -> None:
        """Adapt to the first of the frames that were looked at and not learnt, except where something is followed."""
        looked = self._waiting.popleft()
        self._background.learn(looked.frame.image, looked.frame.t, self._outlines(*followed), looked.raw)
        self._darkness.learn(looked.hard, looked.light, self._outlines(*followed))

    def _outlines(self, pose: Array, size: Array) -> Iterator[Array]:
        """Outlines (k, 2) px of N boxes as the footage shows them, found when they are asked for: few frames are."""
        for hull in contour.hulls_of(self._camera, wireframe.projected(self._camera, pose, size)):
            if len(hull):
                yield hull


@dataclass(frozen=True, slots=True)
class _Looked:
    """A frame, its labels (H, W), those without shadows that fade into the ground, of which the sun casts none, and how
    light it is against the background."""

    frame: Frame
    raw: Image
    hard: Image
    light: Image


def _grey(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
