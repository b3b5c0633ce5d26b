"""Which vehicle of a scene is where and seen: the truth that a track can be held against."""

from __future__ import annotations

import cv2
import numpy as np

from samples.render import far_to_near
from samples.scene import NEAREST_DEPTH, Array, Scene, share_inside

SCALE = 4  # px of the picture in one of the raster in which hiding is counted
LEAST_INSIDE, LEAST_OPEN = 0.5, 0.25


def truth_rows(scene: Scene) -> list[tuple[int, float, int, Array]]:
    """(frame, t, id, state (5,)) by frame and id.

    Wherever half of the vehicle's box is inside the picture and a quarter of what is inside is not hidden by others.
    """
    rows = []
    states = {vehicle.id: vehicle.trajectory(scene.times) for vehicle in scene.vehicles}
    for frame, t in enumerate(scene.times):
        boxes = [(vehicle, vehicle.corners(states[vehicle.id][frame])) for vehicle in scene.vehicles]
        boxes = [(vehicle, box) for vehicle, box in boxes if scene.camera.depth(box).min() > NEAREST_DEPTH]
        inside = {vehicle.id: share_inside(scene.camera, box) for vehicle, box in boxes}
        raster = np.zeros((scene.camera.size[1] // SCALE, scene.camera.size[0] // SCALE), np.int16)
        alone = {}
        for vehicle, box in far_to_near(scene.camera, [item for item in boxes if inside[item[0].id] > 0]):
            hull = cv2.convexHull(np.round(scene.camera.project(box) / SCALE).astype(np.int32))
            own = cv2.fillConvexPoly(np.zeros_like(raster, np.uint8), hull, 1) > 0
            alone[vehicle.id] = max(1, int(own.sum()))
            raster[own] = vehicle.id
        left = np.bincount(raster.ravel(), minlength=max([0, *alone]) + 1)
        rows += [
            (frame, float(t), number, states[number][frame])
            for number in sorted(alone)
            if inside[number] >= LEAST_INSIDE and left[number] >= LEAST_OPEN * alone[number]
        ]
    return rows
