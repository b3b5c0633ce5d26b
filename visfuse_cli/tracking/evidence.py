"""What one frame says about followed things: a picture of labels, or detections from outside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.assignment import assign
from visfuse_cli.records import Array, Boxes, GroundCamera, Image, Region
from visfuse_cli.tracking.association import overlap, region_boxes
from visfuse_cli.vision import contour, regions, wireframe
from visfuse_cli.vision.contour import Fill, Look, Sight
from visfuse_cli.vision.labels import Labels
from visfuse_cli.vision.points import Corners
from visfuse_cli.vision.regions import Band, Cleaned
from visfuse_cli.vision.wireframe import Outlines

MARGIN = 0.08  # of a vehicle's width in the picture: what lies closer to it is its own
LEAST_IOU = 0.2  # of a detection and the box expected there


class Evidence(Protocol):
    """One frame, ready to be asked."""

    def look(self, pose: Array, size: Array, reach: Array) -> Look:
        """Look for N boxes where they are expected, at most `reach` (N,) px off; they hide one another."""

    def probe(self, pose: Array, size: Array, reach: Array, taken: Boxes) -> Look:
        """Look for each of N boxes as if it alone stood among those `taken`."""

    def outlines(self, pose: Array, size: Array, reach: Array, taken: Boxes) -> Outlines:
        """The outlines that `probe` finds, and nothing else."""

    def leftovers(self, pose: Array, size: Array) -> list[Region]:
        """Regions that the N boxes do not explain."""

    def corners(self) -> Corners | None:
        """What the corners of that which moves tell in the present frame, where they are followed."""

    def pack(self) -> None:
        """Take little memory from now on: the frame is past."""


class LabelEvidence:
    """A labelled picture (255 foreground, 127 shadow), and of the present frame the cleaned one and the corners."""

    def __init__(
        self,
        labels: Image,
        camera: GroundCamera,
        cut: list[Band],
        gap_m: float,
        speck_m: float,
        smallest_m: float,
        cleaned: Cleaned | None = None,
        corners: Corners | None = None,
        sunny: bool = False,
    ) -> None:
        self._labels, self._cleaned, self._corners, self._past = Labels(labels), cleaned, corners, False
        self._owned: tuple[bytes, Image] | None = None  # the boxes asked about last, and whose each pixel is
        self._camera, self._cut = camera, cut
        self._sunny = sunny  # shadows are told by their darkness: only paint exactly as dark is taken for one
        self._gap, self._speck, self._smallest = gap_m, speck_m, smallest_m

    def pack(self) -> None:
        self._labels.pack()
        self._owned = self._cleaned = self._corners = None
        self._past = True

    def corners(self) -> Corners | None:
        return self._corners

    def look(self, pose: Array, size: Array, reach: Array) -> Look:
        code = np.arange(1, len(pose) + 1)
        return contour.search([self._among((pose, size))], code, self._camera, pose, size, reach, beyond=True)

    def probe(self, pose: Array, size: Array, reach: Array, taken: Boxes) -> Look:
        return contour.search([self._among(taken)], np.zeros(len(pose), int), self._camera, pose, size, reach)

    def outlines(self, pose: Array, size: Array, reach: Array, taken: Boxes) -> Outlines:
        nobody = np.zeros(len(pose), int)
        return contour.profiles([self._among(taken)], nobody, self._camera, pose, size, reach).outlines

    @staticmethod
    def probe_each(frames: Sequence[LabelEvidence], pose: Array, size: Array, reach: Array, taken: list[Boxes]) -> Look:
        """Look for N boxes, each in a frame of its own as if it alone stood among those `taken` there."""
        sights = [frame._among(boxes) for frame, boxes in zip(frames, taken, strict=True)]
        return contour.search(sights, np.zeros(len(pose), int), frames[0]._camera, pose, size, reach)

    def _among(self, boxes: Boxes) -> Sight:
        """What is seen among boxes; the present frame is asked again and again about the same ones."""
        key = boxes[0].tobytes() + boxes[1].tobytes()
        if self._past:
            return Sight(self._labels, contour.owners(self._camera, *boxes), self._sunny)
        if self._owned is None or self._owned[0] != key:
            self._owned = key, contour.owners(self._camera, *boxes)
        return Sight(self._labels, self._owned[1], self._sunny)

    def fill(self, pose: Array, size: Array, taken: Boxes) -> Fill:
        """A quick look at each of N boxes as if it alone stood among those `taken`."""
        return contour.fill(self._among(taken), self._camera, pose, size)

    def leftovers(self, pose: Array, size: Array) -> list[Region]:
        if self._cleaned is None:
            self._cleaned = regions.cleaned(self._labels.picture(), self._cut, self._speck)
        found = regions.find(self._cleaned, self._cut, self._gap, self._smallest, self._explained(pose, size))
        lens = self._camera.ground.lens
        return found if lens is None else [regions.undistorted(region, lens) for region in found]

    def _explained(self, pose: Array, size: Array) -> Image:
        """Mask (H, W), 255 in and close to the silhouettes of N boxes."""
        width, height = self._camera.image_size
        explained = np.zeros((height, width), np.uint8)
        pixels = wireframe.projected(self._camera, pose, size)
        extent = np.ptp(pixels, axis=2).max(axis=0)
        for hull, across in zip(contour.hulls_of(self._camera, pixels), extent, strict=True):
            if len(hull):
                cv2.fillConvexPoly(explained, hull, 255)
                cv2.polylines(explained, [hull], True, 255, 2 * max(2, round(MARGIN * float(across))) + 1)
        return explained


class BoxEvidence:
    """Upright boxes from an external detector, as regions."""

    def __init__(self, boxes: list[Region], camera: GroundCamera) -> None:
        self._regions, self._camera = boxes, camera

    def look(self, pose: Array, size: Array, reach: Array) -> Look:
        seen: list[Outlines] = [_nothing() for _ in pose]
        share = np.full(len(pose), np.nan)
        for region, thing in self._pairs(pose, size)[0]:
            seen[thing] = self._sides(region)
            share[thing] = 1.0
        return Look(Outlines.stack(seen), share, share, share, share, 0 * share, share, share, share)

    def probe(self, pose: Array, size: Array, reach: Array, taken: Boxes) -> Look:
        free = set(self._pairs(*taken)[1].tolist())
        iou = self._overlaps(pose, size)
        iou[[k for k in range(len(iou)) if k not in free]] = 0
        seen, share = [_nothing() for _ in pose], np.full(len(pose), np.nan)
        if len(iou):
            for thing, best in enumerate(np.argmax(iou, axis=0)):
                if iou[best, thing] >= LEAST_IOU:
                    seen[thing] = self._sides(best)
                    share[thing] = 1.0
        return Look(Outlines.stack(seen), share, share, share, share, 0 * share, share, share, share)

    def outlines(self, pose: Array, size: Array, reach: Array, taken: Boxes) -> Outlines:
        return self.probe(pose, size, reach, taken).outlines

    def corners(self) -> Corners | None:
        return None

    def pack(self) -> None:
        """A few boxes are little."""

    def leftovers(self, pose: Array, size: Array) -> list[Region]:
        return [self._regions[k] for k in self._pairs(pose, size)[1]]

    def _pairs(self, pose: Array, size: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Pairs (k, 2) of a detection and a box, and the detections left."""
        iou = self._overlaps(pose, size)
        pairs, free, _ = assign(np.where(iou >= LEAST_IOU, 1 - iou, np.inf))
        return pairs, free

    def _overlaps(self, pose: Array, size: Array) -> Array:
        """Intersection over union (R, N) of each detection with each expected box."""
        pixels = np.nan_to_num(wireframe.projected(self._camera, pose, size), nan=-1e4)
        expected = np.concatenate([pixels.min(axis=2), pixels.max(axis=2)]).T
        return overlap(region_boxes(self._regions), expected)[0]

    def _sides(self, number: int) -> Outlines:
        box = self._regions[number]
        return wireframe.tangents(box.hull, box.at_border, upright=True)


def probe_each(frames: Sequence[Evidence], pose: Array, size: Array, reach: Array, taken: list[Boxes]) -> Look:
    """Look for N boxes, each in a frame of its own as if it alone stood among those `taken` there."""
    labelled = [frame for frame in frames if isinstance(frame, LabelEvidence)]
    if len(labelled) == len(frames):
        return LabelEvidence.probe_each(labelled, pose, size, reach, taken)
    each = [slice(k, k + 1) for k in range(len(pose))]
    return Look.joined(
        [frame.probe(pose[k], size[k], reach[k], boxes) for frame, k, boxes in zip(frames, each, taken, strict=True)]
    )


def _nothing() -> Outlines:
    return wireframe.tangents(np.zeros((1, 2)), np.ones(1, dtype=bool), upright=True)
