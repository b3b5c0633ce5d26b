"""Foreground pixels to regions, cleaned at a scale that follows the ground plane."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.cameras import project
from visfuse_cli.maths.homography import apply
from visfuse_cli.records import Array, GroundCamera, Image, Lens, Region
from visfuse_cli.vision.background import FOREGROUND
from visfuse_cli.vision.lens import undistort_points

BODY_M = 1.1, 0.9  # width and height of what is a vehicle and no part of one
CAR_M = 4.5, 2.4  # width and height that the parts of one car can span in the picture
NEIGHBOURS = np.array([(i, j) for i in (-2, 0, 2) for j in (-2, 0, 2)]).T  # (2, 9) px
LEAST_OPENING_PX = 3  # coding noise along edges of the background comes in specks of two


@dataclass(frozen=True, slots=True)
class Band:
    """Image rows in which one metre of height covers about `scale` px."""

    top: int
    bottom: int
    scale: float


def bands(camera: GroundCamera) -> list[Band]:
    """Cut the image into bands of rows whose scale stays within a factor of 1.4.

    The scale of a row is that of an upright metre standing on the ground in the middle of it.
    """
    width, height = camera.image_size
    rows = np.arange(height, dtype=float)
    feet = np.column_stack([np.full(height, width / 2), rows])
    H = camera.ground.ground_from_image
    visible = (feet @ H[2, :2] + H[2, 2]) * camera.ground.ground_sign > 0
    scale = np.full(height, np.nan)
    if visible.any():
        ground = apply(H, feet[visible])
        tops, _ = project(camera, np.column_stack([ground, np.ones(len(ground))]))
        scale[visible] = np.linalg.norm(tops - feet[visible], axis=1)
    known = np.isfinite(scale)
    if not known.any():
        return [Band(0, height, 20.0)]
    scale = np.interp(rows, rows[known], scale[known])
    octave = np.round(2 * np.log2(np.clip(scale, 2, 400))).astype(int)
    starts = np.flatnonzero(np.diff(octave, prepend=octave[0] - 1))
    ends = np.append(starts[1:], height)
    return [Band(int(a), int(b), float(2 ** (octave[a] / 2))) for a, b in zip(starts, ends, strict=True)]


@dataclass(frozen=True, slots=True)
class Cleaned:
    """A labelled picture without specks: masks (H, W) of paint (255) and of all that moved, shadow included (1)."""

    paint: Image
    moved: Image


def cleaned(labels: Image, cut: list[Band], speck_m: float) -> Cleaned:
    """Take the specks out of a labelled picture (255 foreground, 127 shadow); they grow with each band's scale."""
    paint = np.empty_like(labels)
    for band in cut:
        opening = _kernel(max(speck_m * band.scale, LEAST_OPENING_PX))
        top, bottom = max(0, band.top - len(opening)), min(len(labels), band.bottom + len(opening))
        mask = cv2.compare(labels[top:bottom], FOREGROUND, cv2.CMP_EQ)
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, opening)
        paint[band.top : band.bottom] = mask[band.top - top : band.bottom - top]
    moved = cv2.morphologyEx(cv2.min(labels, 1), cv2.MORPH_OPEN, _kernel(LEAST_OPENING_PX))
    return Cleaned(paint, np.asarray(moved, dtype=np.uint8))


def _closed(paint: Image, cut: list[Band], gap_m: float, explained: Image) -> Image:
    """What is painted (255) and not `explained` (255), its gaps closed up to `gap_m`."""
    left_over = np.asarray(cv2.subtract(paint, explained), dtype=np.uint8)
    out = np.zeros_like(paint)
    for band in cut:
        closing = _kernel(gap_m * band.scale)
        margin = len(closing)
        top, bottom = max(0, band.top - margin), min(len(paint), band.bottom + margin)
        left, _, wide, _ = cv2.boundingRect(left_over[top:bottom])
        across = slice(max(0, left - margin), left + wide + margin)
        if wide:
            mask = cv2.morphologyEx(left_over[top:bottom, across], cv2.MORPH_CLOSE, closing)
            out[band.top : band.bottom, across] = mask[band.top - top : band.bottom - top]
    return np.asarray(cv2.subtract(out, explained), dtype=np.uint8)


def _kernel(size: float) -> Image:
    side = int(np.clip(round(size), 1, 61))
    return np.ones((side, side), np.uint8)


def find(picture: Cleaned, cut: list[Band], gap_m: float, smallest_m: float, explained: Image) -> list[Region]:
    """Regions of a labelled picture without specks: connected, at least `smallest_m` tall or wide.

    Lengths are metres at each band's scale; hulls run through pixel centres. What is `explained` (255) belongs to no
    region; hull points beside it count as on the border.
    """
    mask = _closed(picture.paint, cut, gap_m, explained)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    contours = [contour for contour in contours if min(cv2.boundingRect(contour)[2:]) >= 2]
    if not contours:
        return []
    components = _Components(np.asarray(cv2.subtract(picture.moved, explained), dtype=np.uint8))
    height, width = mask.shape
    scale = np.concatenate([np.full(band.bottom - band.top, band.scale) for band in cut])
    hulls = [cv2.convexHull(contour).reshape(-1, 2).astype(float) for contour in contours]
    every = np.concatenate(hulls)
    ends = np.cumsum([len(hull) for hull in hulls])
    borders = np.split(at_border(every, (width, height)) | _beside(every, explained), ends[:-1])
    bodies: list[Region] = []
    parts: dict[int, list[tuple[Region, float]]] = {}  # of one moving component: windows, wheels, bumpers
    for contour, hull, border in zip(contours, hulls, borders, strict=True):
        x, y, w, h = cv2.boundingRect(contour)
        box = np.array([x - 0.5, y - 0.5, w, h], dtype=float)
        area = float(cv2.contourArea(contour))
        number, around, around_area = components.around(contour.reshape(-1, 2)) or (-1, box, area)
        region = Region(box, hull, border, area, around, around_area)
        metre = scale[y + h - 1]
        if w > BODY_M[0] * metre and h > BODY_M[1] * metre:
            bodies.append(region)
        else:
            parts.setdefault(number, []).append((region, metre))
    gathered = [*bodies, *(region for group in parts.values() for region in _gathered(group))]
    return [
        region
        for region in gathered
        if np.max(region.box[2:]) >= smallest_m * scale[min(int(region.box[1] + region.box[3]), height - 1)]
    ]


class _Components:
    """The connected parts of a mask (1), found one by one as they are asked for."""

    def __init__(self, mask: Image) -> None:
        self._left, self._top, wide, high = cv2.boundingRect(mask)
        self._number = mask[self._top : self._top + high, self._left : self._left + wide].astype(np.int32)
        self._extent: list[tuple[Array, float]] = []

    def around(self, points: NDArray[np.int32]) -> tuple[int, Array, float] | None:
        """Number, box (4,) px and area px^2 of the part that `points` (k, 2) of a contour lie in; None if in none."""
        u, v = points[:, 0] - self._left, points[:, 1] - self._top
        high, wide = self._number.shape
        within = (u >= 0) & (u < wide) & (v >= 0) & (v < high)
        u, v = u[within], v[within]
        inside = np.flatnonzero(self._number[v, u])
        if not len(inside):
            return None
        middle = inside[len(inside) // 2]
        at = int(u[middle]), int(v[middle])
        if self._number[at[::-1]] == 1:
            number = len(self._extent) + 2
            area, _, _, (x, y, w, h) = cv2.floodFill(self._number, None, at, number, flags=4)
            self._extent.append((np.array([x + self._left - 0.5, y + self._top - 0.5, w, h]), float(area)))
        number = int(self._number[at[::-1]])
        return number, *self._extent[number - 2]


def _gathered(parts: list[tuple[Region, float]]) -> list[Region]:
    """Parts (each with its px per m) that lie in one moving component, joined as long as a car can hold them."""
    wholes: list[tuple[Region, float]] = []
    for part, metre in sorted(parts, key=lambda item: -item[0].area):
        for k, (whole, largest) in enumerate(wholes):
            both, scale = joined([whole, part]), max(metre, largest)
            if both.box[2] <= CAR_M[0] * scale and both.box[3] <= CAR_M[1] * scale:
                wholes[k] = both, scale
                break
        else:
            wholes.append((part, metre))
    return [whole for whole, _ in wholes]


def at_border(hull: Array, frame_size: tuple[int, int]) -> NDArray[np.bool_]:
    """Which hull points (k, 2) px lie on the border of a frame (w, h)."""
    return np.asarray(np.any((hull <= 1.5) | (hull >= np.array(frame_size) - 2.5), axis=1))


def _beside(hull: Array, explained: Image) -> NDArray[np.bool_]:
    """Which hull points (k, 2) px have something explained next to them."""
    height, width = explained.shape
    u, v = np.clip(hull.astype(int).T[:, None] + NEIGHBOURS[..., None], 0, [[[width - 1]], [[height - 1]]])  # (9, k)
    return np.asarray((explained[v, u] > 0).any(axis=0))


def joined(parts: list[Region]) -> Region:
    """One region around several fragments of the same thing."""
    if len(parts) == 1:
        return parts[0]
    points = np.concatenate([part.hull for part in parts])
    border = np.concatenate([part.at_border for part in parts])
    kept = cv2.convexHull(points.astype(np.float32), returnPoints=False).ravel()
    corner = np.min([part.box[:2] for part in parts], axis=0)
    far = np.max([part.box[:2] + part.box[2:] for part in parts], axis=0)
    box = np.concatenate([corner, far - corner])
    return replace(parts[0], box=box, hull=points[kept], at_border=border[kept], area=sum(part.area for part in parts))


def from_box(box: Array, score: float, frame_size: tuple[int, int]) -> Region:
    """A region from an external detection box [x, y, w, h] px."""
    x, y, w, h = box
    hull = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])
    return Region(
        np.asarray(box, dtype=float), hull, at_border(hull, frame_size), float(w * h), box, float(w * h), score, True
    )


def undistorted(region: Region, lens: Lens) -> Region:
    """The region as a camera without distortion would see it."""
    hull = undistort_points(region.hull, lens)
    low, high = hull.min(axis=0) - 0.5, hull.max(axis=0) + 0.5
    u, v, w, h = region.around
    ends = undistort_points(np.array([[u, v], [u + w, v], [u + w, v + h], [u, v + h]]), lens)
    around = np.concatenate([ends.min(axis=0), np.ptp(ends, axis=0)])
    return replace(region, box=np.concatenate([low, high - low]), hull=hull, around=around)
