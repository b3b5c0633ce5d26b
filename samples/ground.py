"""What stands still: asphalt, grass and markings, painted once through the camera's homography."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from samples.scene import Array, Road, Scene

FINE = 3
BAND = 60
TILE = 512
LINE = 0.15
DASH, DASH_PERIOD = 3.0, 9.0
STREAM = 1


def paint(scene: Scene) -> NDArray[np.uint8]:
    """The empty scene (H, W, 3) BGR, averaged from FINE x FINE points a pixel."""
    width, height = scene.camera.size
    road_from_image = np.linalg.inv(scene.camera.image_from_ground() @ scene.placement.matrix())
    rng = np.random.default_rng((scene.seed, STREAM))
    tiles = [_tile(rng) for _ in range(3)]
    picture = np.empty((height, width, 3), np.uint8)
    u = (np.arange(width * FINE) + 0.5) / FINE - 0.5
    for top in range(0, height, BAND):
        rows = min(BAND, height - top)
        v = top + (np.arange(rows * FINE) + 0.5) / FINE - 0.5
        grid = np.stack([*np.meshgrid(u, v), np.ones((len(v), len(u)))], axis=-1)
        x, y, w = np.moveaxis(grid @ road_from_image.T, -1, 0)
        fine = _colour(scene.road, x / w, y / w, tiles)
        # behind the horizon the plane's points lie at the camera's back
        fine[(y / w < -50) | (y / w > 400)] = (205, 190, 175)
        small = cv2.resize(fine, (width, rows), interpolation=cv2.INTER_AREA)
        picture[top : top + rows] = np.clip(np.rint(small), 0, 255).astype(np.uint8)
    return picture


def _colour(road: Road, x: Array, y: Array, tiles: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Colours (..., 3) at points of the road's frame."""
    fine, coarse, wide = (_noise(tile, x, y, cell) for tile, cell in zip(tiles, (0.05, 0.4, 2.5), strict=True))
    asphalt = 104 + 7 * fine + 8 * coarse + 7 * wide
    grass = 92 + 14 * fine + 14 * coarse + 10 * wide
    left, right = road.edges
    paved = (x > left - 0.3) & (x < right + 0.3)
    if road.crossing is not None:
        paved |= (y > road.crossing[0]) & (y < road.crossing[1])
    colour = np.stack([grass * 0.62, grass * 1.08, grass * 0.85], axis=-1).astype(np.float32)
    colour[paved] = (asphalt[..., None] * np.array([1.02, 1.0, 0.98]))[paved]
    marked = _marked(road, x, y)
    colour[marked] = (212 + 6 * coarse[..., None] + np.zeros(3))[marked]
    return colour


def _marked(road: Road, x: Array, y: Array) -> NDArray[np.bool_]:
    """Where paint lies: solid edges, dashes between lanes, a solid middle on wide roads, stop lines."""
    left, right = road.edges
    dashed = np.mod(y, DASH_PERIOD) < DASH
    marked = (np.abs(x - left - LINE) < LINE / 2) | (np.abs(x - right + LINE) < LINE / 2)
    lanes = sorted(road.lanes)
    for (x0, way0), (x1, way1) in pairwise(lanes):
        line = np.abs(x - (x0 + x1) / 2) < LINE / 2
        marked |= line & dashed if way0 == way1 or len(lanes) == 2 else line
    if road.crossing is not None:
        marked &= (y < road.crossing[0]) | (y > road.crossing[1])
    for stop, way in road.stop_lines:
        for middle in (lane for lane, its_way in lanes if its_way == way):
            marked |= (np.abs(x - middle) < road.lane_width / 2) & (np.abs(y - stop) < 0.2)
    return marked


def _tile(rng: np.random.Generator) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(rng.normal(0, 1, (TILE, TILE)), (0, 0), 0.8), dtype=np.float32)


def _noise(tile: NDArray[np.float32], x: Array, y: Array, cell: float) -> NDArray[np.float32]:
    """The tile, repeated over the plane at `cell` metres an element, at the points."""
    map_x, map_y = (np.mod(axis / cell, TILE).astype(np.float32) for axis in (x, y))
    return np.asarray(cv2.remap(tile, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), dtype=np.float32)
