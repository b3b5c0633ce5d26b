"""Corners of what moves, followed from picture to picture: which way each was going when it last moved."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.cameras import below_horizon
from visfuse_cli.maths.homography import apply
from visfuse_cli.records import Array, GroundCamera, Image
from visfuse_cli.vision.lens import undistort_points

WIDTH_PX = 640  # of the pictures in which corners are followed
WINDOW, LEVELS = (13, 13), 3
CELL_PX, BLOCK_CELLS, BLOCK_MOST = 7, 5, 6  # one corner a cell, and the best of each block of cells
SHARP = 1e-4  # least eigenvalue that is no noise, of gradients of grey levels from 0 to 1
SEEK_S = 0.15  # s between searches for new corners
WAY_M, WAY_PX = 1.0, 2.5  # that a corner must have gone, on the ground and in the small picture, to tell its course
NOW_S = 0.3  # s over which its present velocity is smoothed


@dataclass(frozen=True, slots=True)
class Moves:
    """Where (n, 2) px corners were in the picture before this one and are now, `dt` s later."""

    before: Array
    now: Array
    dt: float


@dataclass(frozen=True, slots=True)
class Courses:
    """Corners that have moved: place (n, 2) px, velocity (n, 2) m/s and course (n,) rad when they last moved.

    The velocity is that of the place on the ground behind the corner: its direction is true whatever the height.
    """

    place: Array
    velocity: Array
    course: Array

    def __getitem__(self, which: NDArray[np.bool_]) -> Courses:
        return Courses(self.place[which], self.velocity[which], self.course[which])


@dataclass(frozen=True, slots=True)
class Corners:
    """What the corners in a picture tell."""

    moves: Moves
    courses: Courses


class MovingPoints:
    """Corners inside a mask, followed by pyramids (Lucas and Kanade) at a bounded width."""

    def __init__(self, camera: GroundCamera) -> None:
        self._camera = camera
        self._scale = _scale(camera)
        self._last: Image | None = None
        self._place = np.zeros((0, 2), np.float32)  # px of the small picture
        self._ground = np.zeros((0, 2))  # m
        self._velocity = np.zeros((0, 2))  # m/s, smoothed; NaN before the second picture
        self._anchor = np.zeros((0, 4))  # u, v, X, Y from which the present stretch is counted
        self._course = np.zeros(0)  # rad; NaN: not known yet
        self._sought = self._t = -np.inf

    def follow(self, picture: Image, t: float, wanted: Image) -> Corners:
        """Take in a grey picture (H, W) at t (s), and what it tells; corners live where `wanted` (H, W) is not 0."""
        size = (round(picture.shape[1] / self._scale), round(picture.shape[0] / self._scale))
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if self._scale > 1 else picture
        mask = cv2.resize(wanted, size, interpolation=cv2.INTER_NEAREST) if self._scale > 1 else wanted
        moves = Moves(np.zeros((0, 2)), np.zeros((0, 2)), 1.0)
        if len(self._place) and self._last is not None:
            before = self._pixels()
            kept = self._advance(small, mask)
            moves = Moves(before[kept], self._pixels(), max(t - self._t, 1e-6))
            self._tell(t)
        if t - self._sought >= SEEK_S:
            self._sought = t
            self._seek(small, mask)
        self._last, self._t = small, t
        known = np.isfinite(self._course) & np.isfinite(self._velocity[:, 0])
        return Corners(moves, Courses(self._pixels()[known], self._velocity[known], self._course[known]))

    def _pixels(self) -> Array:
        pixels = (self._place.astype(float) + 0.5) * self._scale - 0.5
        lens = self._camera.ground.lens
        return pixels if lens is None or not len(pixels) else undistort_points(pixels, lens)

    def _advance(self, small: Image, mask: Image) -> NDArray[np.bool_]:
        """Follow the corners into the next picture; which of them are there."""
        assert self._last is not None
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            self._last, small, self._place, None, winSize=WINDOW, maxLevel=LEVELS
        )
        high, wide = small.shape
        u, v = np.round(found).astype(int).T
        inside = (u >= 0) & (u < wide) & (v >= 0) & (v < high) & (status.ravel() > 0)
        inside[inside] = mask[v[inside], u[inside]] > 0
        self._place = found
        self._keep(inside)
        return inside

    def _keep(self, which: NDArray[np.bool_]) -> None:
        self._place, self._anchor, self._course = self._place[which], self._anchor[which], self._course[which]
        self._ground, self._velocity = self._ground[which], self._velocity[which]

    def _tell(self, t: float) -> None:
        """Note how fast the corners are, and the course of those that have gone far enough to tell."""
        ground, dt = self._on_ground(self._pixels()), max(t - self._t, 1e-6)
        now = (ground - self._ground) / dt
        before = np.where(np.isfinite(self._velocity), self._velocity, now)
        self._ground, self._velocity = ground, before + (now - before) * min(1.0, dt / NOW_S)
        way = ground - self._anchor[:, 2:]
        in_picture = np.linalg.norm(self._place - self._anchor[:, :2], axis=1)
        far = (np.hypot(*way.T) > WAY_M) & (in_picture > WAY_PX)
        self._course[far] = np.arctan2(way[far, 1], way[far, 0])
        self._anchor[far] = np.column_stack([self._place[far], ground[far]])

    def _on_ground(self, pixels: Array) -> Array:
        """Ground places (n, 2) m behind pixels (n, 2), NaN above the horizon."""
        ground = apply(self._camera.ground.ground_from_image, pixels)
        return np.where(below_horizon(self._camera, pixels)[:, None], ground, np.nan)

    def _seek(self, small: Image, mask: Image) -> None:
        free = cv2.erode(mask, np.ones((3, 3), np.uint8))
        left, top, wide, high = cv2.boundingRect(free)
        if not wide:
            return
        part = np.s_[top : top + high, left : left + wide]
        sharp = cv2.cornerMinEigenVal(small[part], 5) * (free[part] > 0)
        fresh = _best_of_cells(sharp, self._place - [left, top]) + np.array([left, top])
        fresh = fresh.astype(np.float32)
        old = len(self._place)
        self._place = np.concatenate([self._place, fresh]).astype(np.float32)
        ground = self._on_ground(self._pixels()[old:])
        self._ground = np.concatenate([self._ground, ground])
        self._anchor = np.concatenate([self._anchor, np.column_stack([fresh, ground])])
        self._velocity = np.concatenate([self._velocity, np.full(ground.shape, np.nan)])
        self._course = np.concatenate([self._course, np.full(len(fresh), np.nan)])


def window_px(camera: GroundCamera) -> float:
    """How far (px) around a corner the picture tells where it goes."""
    return WINDOW[0] / 2 * _scale(camera)


def _scale(camera: GroundCamera) -> float:
    """How many times as large as the small pictures those of a camera are."""
    return max(1.0, camera.image_size[0] / WIDTH_PX)


def _best_of_cells(sharp: Array, taken: Array) -> Array:
    """The sharpest pixel (n, 2) of each cell of a map (H, W), the best few of a block; none in cells that are taken."""
    side = CELL_PX * BLOCK_CELLS
    high, wide = (-(-length // side) * side for length in sharp.shape)
    padded = np.zeros((high, wide), sharp.dtype)
    padded[: sharp.shape[0], : sharp.shape[1]] = sharp
    down, across = high // CELL_PX, wide // CELL_PX
    cells = padded.reshape(down, CELL_PX, across, CELL_PX).swapaxes(1, 2).reshape(down, across, -1)
    at, value = cells.argmax(axis=2), cells.max(axis=2)
    v, u = np.floor(taken / CELL_PX).astype(int).T[::-1]
    inside = (u >= 0) & (u < across) & (v >= 0) & (v < down)
    held = np.zeros((down, across), bool)
    held[v[inside], u[inside]] = True
    value = np.where(held, np.inf, value)  # what is followed already counts among the best of its block
    blocks = value.reshape(down // BLOCK_CELLS, BLOCK_CELLS, across // BLOCK_CELLS, BLOCK_CELLS).swapaxes(1, 2)
    ranks = (-blocks.reshape(*blocks.shape[:2], -1)).argsort(axis=2).argsort(axis=2).reshape(blocks.shape)
    good = (ranks.swapaxes(1, 2).reshape(down, across) < BLOCK_MOST) & (value > SHARP) & ~held
    v, u = np.nonzero(good)
    return np.column_stack([u * CELL_PX + at[good] % CELL_PX, v * CELL_PX + at[good] // CELL_PX])
