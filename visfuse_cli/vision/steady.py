"""A camera that shakes or was knocked: where each picture lies against the scene at rest, and the picture laid back."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.medians import median
from visfuse_cli.records import Array, Image
from visfuse_cli.vision.exposure import Exposure, levelled

CELLS, LEAST_POINTS = (16, 10), 12  # across and down: the best corner of each is looked for again
EDGE = 8  # px from the picture's edge, at least
WINDOW, LEVELS = (21, 21), 2
SETTLED = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 10, 0.02)  # rounds at most, px: what stands still is quick
ROUNDS = 6  # of weighing
AGREE_PX = 1.0  # a corner that is further off does not belong to what stands still
LEAST_AGREEING, LEAST_SHARE = 8, 0.15  # of the corners must agree; vehicles hide many, foliage moves
TURNED_PX = 0.12  # less of a turn is none
STILL_PX = 0.12  # less is left as it is: laying a picture back softens it
FAR_PX = 5.0  # a larger turn of the camera is no similarity in the picture any more
DARK = 16  # grey levels: a scene of which half is darker shows lamps and no corners
SIDES, KNOCK_PX, KNOCK_SHAKES = 4, 3.0, 3.0  # pictures either side of a knock; px, and times the shake, that it moves
COARSE_PX = 320  # width at which a knocked camera is found again


class Steady:
    """Registers pictures to a `reference` (H, W, 3) of the scene at rest by the corners of what stands still."""

    def __init__(self, reference: Image) -> None:
        self._reference = reference
        self._grey = cv2.cvtColor(reference, cv2.COLOR_BGR2GRAY)
        self._points = _corners(self._grey)
        self._dark = bool(np.median(self._grey) < DARK)
        self._sharpness = _sharpness(self._grey, self._points)
        self._weight = np.linalg.det(self._sharpness) ** 0.25
        self._weight /= max(float(self._weight.sum()), 1e-9)
        self._last = np.eye(3)
        self.middle = (np.array(reference.shape[1::-1]) - 1) / 2  # (2,) px

    def register(self, image: Image) -> Array | None:
        """`image_from_rest` (3, 3) px of a picture, None where what stands still cannot be found in it.

        Without enough corners in the scene, or in the dark, a camera counts as steady.
        """
        if len(self._points) < LEAST_POINTS or self._dark:
            return np.eye(3)
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        motion = self._followed(grey, self._last)
        if motion is None:
            motion = self._followed(grey, self._coarse(grey))
        if motion is not None:
            self._last = motion
        return motion

    def laid_back(self, image: Image, image_from_rest: Array) -> Image:
        """The picture as the camera at rest sees it; what lies outside of it is filled from the reference."""
        if self.shift(image_from_rest) < STILL_PX:
            return image
        way = moved(image_from_rest, self.middle) - self.middle
        if self.shift(image_from_rest @ _moving(-way)) < TURNED_PX:
            return _laid_over(self._reference, image, way)
        filled = self._reference.copy()
        size, flags = (image.shape[1], image.shape[0]), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        if np.array_equal(image_from_rest[2], [0, 0, 1]):
            cv2.warpAffine(image, image_from_rest[:2], size, filled, flags, cv2.BORDER_TRANSPARENT)
        else:
            cv2.warpPerspective(image, image_from_rest, size, filled, flags, cv2.BORDER_TRANSPARENT)
        return filled

    def shift(self, image_from_rest: Array) -> float:
        """How far (px) the picture's corners and middle are moved at most."""
        high, wide = self._grey.shape
        at = np.array([[0, 0], [wide, 0], [0, high], [wide, high], [wide / 2, high / 2]])
        return float(np.linalg.norm(moved(image_from_rest, at) - at, axis=1).max())

    def _followed(self, grey: Image, expected: Array) -> Array | None:
        start = moved(expected, self._points.astype(float)).astype(np.float32)
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            self._grey,
            grey,
            self._points,
            start,
            winSize=WINDOW,
            maxLevel=LEVELS,
            criteria=SETTLED,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        seen = status.ravel() > 0
        if np.count_nonzero(seen) < LEAST_POINTS:
            return None
        here, there = self._points[seen], found[seen]
        cv2.setRNGSeed(0)
        similar, agree = cv2.estimateAffinePartial2D(here, there, ransacReprojThreshold=AGREE_PX)
        if similar is None:
            return None
        agreeing = agree.ravel() > 0
        motion = _turn(here[agreeing], there[agreeing], self._sharpness[seen][agreeing])
        if self.shift(motion) > FAR_PX:
            motion, agree = cv2.findHomography(here, there, cv2.RANSAC, AGREE_PX)
            if motion is None:
                return None
            agreeing = agree.ravel() > 0
        # painted lines say more than the grain of asphalt, which compression wipes off
        found_again = max(np.count_nonzero(agreeing) / len(self._points), self._weight[seen][agreeing].sum())
        recognised = np.count_nonzero(agreeing) >= LEAST_AGREEING and found_again >= LEAST_SHARE
        return motion if recognised else None

    def _coarse(self, grey: Image) -> Array:
        """A shift (3, 3) px that brings the reference's edges over the picture's."""
        scale = COARSE_PX / grey.shape[1]
        here, there = (_edges(cv2.resize(each, None, fx=scale, fy=scale)) for each in (self._grey, grey))
        (u, v), _ = cv2.phaseCorrelate(here, there, cv2.createHanningWindow(here.shape[::-1], cv2.CV_32F))
        return _moving(np.array([u, v]) / scale)


def _moving(way: Array) -> Array:
    """The motion (3, 3) of a picture that moves by `way` (2,) px."""
    return np.array([[1, 0, way[0]], [0, 1, way[1]], [0, 0, 1.0]])


def _laid_over(below: Image, image: Image, way: Array) -> Image:
    """A picture (H, W, 3) under what another of its size shows `way` (2,) px further right and down.

    A filter of two by two pixels takes a third of the time of a warp.
    """
    whole = np.floor(way).astype(int)
    u, v = way - whole
    between = cv2.filter2D(image, -1, np.outer([1 - v, v], [1 - u, u]), anchor=(0, 0))
    here, there = [], []
    for side, off in zip(image.shape[:2], whole[::-1], strict=True):
        first, last = max(0, -off), min(side, side - 1 - off)  # the last row and column have no next one
        here.append(slice(first, max(first, last)))
        there.append(slice(first + off, max(first, last) + off))
    rows, columns = here
    over = np.empty_like(below)
    over[rows, columns] = between[tuple(there)]
    over[: rows.start], over[rows.stop :] = below[: rows.start], below[rows.stop :]
    over[rows, : columns.start] = below[rows, : columns.start]
    over[rows, columns.stop :] = below[rows, columns.stop :]
    return over


def moved(motion: Array, points: Array) -> Array:
    """Points (..., 2) px under a homography (3, 3)."""
    mapped = points @ motion[:, :2].T + motion[:, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])


def at_rest(pictures: Iterable[Image]) -> tuple[list[Image], float]:
    """Pictures (H, W, 3) of one camera, each as seen from the middle of the places where the camera was at first, and
    how far (px) the camera moves between them, by the median.

    What follows a knock does not count. All are as bright as the first; one in which the scene cannot be found again is
    left out.
    """
    waiting = iter(pictures)
    first = next(waiting)
    steady, exposure = Steady(first), Exposure(first)
    found, motions = [], []
    for picture in itertools.chain([first], waiting):
        even = levelled(picture, exposure.gain(picture))
        motion = steady.register(even)
        if motion is not None:
            found.append(even)
            motions.append(motion)
    places = np.array([moved(motion, steady.middle) for motion in motions])
    rest = np.median(motions[: _before_knocks(places)], axis=0)
    ways = [motion @ np.linalg.inv(rest) for motion in motions]
    shake = float(np.median([steady.shift(way) for way in ways]))
    for k, way in enumerate(ways):
        found[k] = steady.laid_back(found[k], way)  # one by one: they fill memory
    return found, shake


def _before_knocks(places: Array) -> int:
    """How many of the places (n, 2) px, in the order of time, come before the camera was knocked for good."""
    count = len(places)
    while count >= 2 * SIDES:
        within = []
        for k in range(SIDES, count - SIDES + 1):
            sides = places[:k], places[k:count]
            within.append(sum(float(np.linalg.norm(side - np.median(side, axis=0), axis=1).sum()) for side in sides))
        k = SIDES + int(np.argmin(within))
        way = np.linalg.norm(np.median(places[k:count], axis=0) - np.median(places[:k], axis=0))
        if way < max(KNOCK_PX, KNOCK_SHAKES * min(within) / count):
            return count
        count = k
    return count


def _turn(here: NDArray[np.float32], there: NDArray[np.float32], sharpness: Array) -> Array:
    """The small turn and shift (3, 3) that brings points (k, 2) onto others: a shaken camera does not zoom.

    Each point counts by its sharpness (k, 2, 2), an edge only across itself; those that are off count less and less.
    """
    middle = here.mean(axis=0, dtype=float)
    u, v = (here - middle).T.astype(float)
    ones, none = np.ones_like(u), np.zeros_like(u)
    J = np.stack([np.stack([ones, none, -v], axis=-1), np.stack([none, ones, u], axis=-1)], axis=1)  # (k, 2, 3)
    off = (there - here).astype(float)
    J_G = J.transpose(0, 2, 1) @ sharpness  # (k, 3, 2)
    squares, wanted = (J_G @ J).reshape(-1, 9), (J_G @ off[..., None])[..., 0]
    step, weight = np.zeros(3), ones
    for _ in range(ROUNDS):
        step = np.linalg.solve((weight @ squares).reshape(3, 3), weight @ wanted)
        error = off - J @ step
        size = ((error[:, None] @ sharpness)[:, 0] * error).sum(axis=1)
        weight = 1 / (1 + size / max(median(size), 1e-12))
    R = np.array([[np.cos(step[2]), -np.sin(step[2])], [np.sin(step[2]), np.cos(step[2])]])
    return np.vstack([np.column_stack([R, step[:2] + middle - R @ middle]), [0, 0, 1]])


def _sharpness(grey: Image, points: NDArray[np.float32]) -> Array:
    """Structure tensors (k, 2, 2) of the picture about points (k, 2): how sharply a shift shows in each direction."""
    smooth = cv2.GaussianBlur(grey, (3, 3), 0)
    gu, gv = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    u, v = points.astype(int).T
    uu, uv, vv = (cv2.blur(a * b, WINDOW)[v, u].astype(float) for a, b in ((gu, gu), (gu, gv), (gv, gv)))
    return np.stack([np.stack([uu, uv], axis=-1), np.stack([uv, vv], axis=-1)], axis=-2) + 1e-6 * np.eye(2)


def _corners(grey: Image) -> NDArray[np.float32]:
    """The best corner (k, 2) px of each cell, those with no contrast at all left out."""
    quality = cv2.cornerMinEigenVal(cv2.GaussianBlur(grey, (3, 3), 0), 7)
    across, down = (
        np.linspace(EDGE, side - EDGE, n + 1).astype(int) for side, n in zip(grey.shape[::-1], CELLS, strict=True)
    )
    found = []
    for top, bottom in itertools.pairwise(down):
        for left, right in itertools.pairwise(across):
            cell = quality[top:bottom, left:right]
            if not cell.size:  # a picture of a few pixels
                continue
            v, u = np.unravel_index(np.argmax(cell), cell.shape)
            if cell[v, u] > 0:
                found.append((left + u, top + v))
    return np.array(found, np.float32).reshape(-1, 2)


def _edges(grey: Image) -> Array:
    smooth = cv2.GaussianBlur(grey, (5, 5), 0)
    return np.asarray(cv2.magnitude(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)))
