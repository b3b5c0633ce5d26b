"""What each frame says to the tracker: where it differs from the adaptive background, or boxes from outside."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from pydantic import Field

from visfuse_cli.config import Section
from visfuse_cli.maths.homography import apply
from visfuse_cli.records import Array, Boxes, GroundCamera
from visfuse_cli.tracking.evidence import BoxEvidence, Evidence, LabelEvidence
from visfuse_cli.tracking.ground import GroundTracker
from visfuse_cli.tracking.lookout import Seen
from visfuse_cli.tracking.sun import Shade, Shadow, Sun, shadow_picture
from visfuse_cli.tracking.zones import Region
from visfuse_cli.vision import regions as region_tools
from visfuse_cli.vision.steady import moved

SETTLED = 12  # frames after which a track's size is known well enough to tell its shadow


class RegionSettings(Section):
    """Cleaning of the foreground, in metres at the scale of the ground."""

    gap: float = Field(0.3, ge=0, le=5, description="m: gaps up to this size are closed")
    speck: float = Field(0.12, ge=0, le=5, description="m: specks below this size are removed")


class Detector(Protocol):
    """A source of evidence, asked frame by frame."""

    def evidence(self, seen: Seen, expected: Boxes) -> Evidence:
        """What a frame says, in which boxes are expected."""

    def learn(self, t: float, tracker: GroundTracker) -> None:
        """Learn from what is followed in the frame at t (s) that evidence was given of."""

    @property
    def shadow(self) -> Shadow | None:
        """Where shadows fall, where that was found."""


class MovingRegions:
    """What differs from the adaptive background, without the shadows that the sun casts."""

    def __init__(self, camera: GroundCamera, shadow_ratio: float, cleaning: RegionSettings, smallest_m: float) -> None:
        self._camera = camera
        self._cleaning = cleaning.gap, cleaning.speck, smallest_m
        self._bands = region_tools.bands(camera)
        self._sun, self._shade = Sun(camera), Shade(shadow_ratio)
        self._labels = np.zeros((0, 0), np.uint8)

    def evidence(self, seen: Seen, expected: Boxes) -> Evidence:
        change = seen.change
        assert change is not None
        labels, cleaned = change.labels, change.cleaned
        if self._sun.shadow is not None and self._shade.needed and len(expected[0]):
            where = shadow_picture(self._camera, *expected, self._sun.shadow.per_metre)
            labels = self._shade.cut(labels, seen.frame.image, change.empty, where)
            if labels is not change.labels:
                cleaned = region_tools.cleaned(labels, self._bands, self._cleaning[1])
        self._labels = labels
        return LabelEvidence(labels, self._camera, self._bands, *self._cleaning, cleaned, change.corners, change.sunny)

    def learn(self, t: float, tracker: GroundTracker) -> None:
        pose, size = tracker.boxes()
        settled = np.array([len(t.samples) >= SETTLED and t.samples[-1].measured for t in tracker.tracks], dtype=bool)
        self._sun.look(t, self._labels, pose, size, settled, [track.id for track in tracker.tracks])

    @property
    def shadow(self) -> Shadow | None:
        return self._sun.shadow


class Detections:
    """Upright boxes from an external detector: frame -> (n, 5) x, y, w, h px and score."""

    def __init__(self, camera: GroundCamera, boxes: dict[int, Array], region: Region | None = None) -> None:
        self._camera, self._boxes, self._region = camera, boxes, region

    def evidence(self, seen: Seen, expected: Boxes) -> Evidence:
        frame = seen.frame
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

    def learn(self, t: float, tracker: GroundTracker) -> None:
        """Boxes from outside cast no shadows."""

    @property
    def shadow(self) -> Shadow | None:
        return None
