"""Frames of a scene: the painted ground, shadows and vehicles over it, shake and noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from samples import ground
from samples.bodies import Patch, body
from samples.scene import NEAREST_DEPTH, NORMALS, Array, Camera, Light, Scene, Vehicle

Image = NDArray[np.uint8]
MARGIN = 64
NOISE_STREAM, SHAKE_STREAM = 2, 3
AMBIENT, DIFFUSE = 0.5, 0.62
SHAKE_MEMORY_S = 0.08
SOFT_PX = 1.5


def frames(scene: Scene) -> Iterator[Image]:
    """The scene's frames (H, W, 3) BGR in order."""
    empty = ground.paint(scene)
    bank = _noise_bank(scene)
    drawn = {vehicle.id: body(vehicle, scene.seed) for vehicle in scene.vehicles}
    states = {vehicle.id: vehicle.trajectory(scene.times) for vehicle in scene.vehicles}
    for index, shift in enumerate(shakes(scene)):
        boxes = [(vehicle, vehicle.corners(states[vehicle.id][index])) for vehicle in scene.vehicles]
        boxes = [(vehicle, box) for vehicle, box in boxes if scene.camera.depth(box).min() > NEAREST_DEPTH]
        picture = empty.copy()
        _shade(picture, empty, scene, [box for _, box in boxes])
        for vehicle, corners in far_to_near(scene.camera, boxes):
            draw(picture, scene.camera, scene.light, corners, drawn[vehicle.id])
        if scene.shake:
            move = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])
            picture = _image(
                cv2.warpAffine(picture, move, scene.camera.size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            )
        yield _noisy(picture, bank, scene.seed, index)


def shakes(scene: Scene) -> Array:
    """How far the picture is moved (n_frames, 2) px: a stationary first-order Markov process, rms `shake`."""
    white = np.random.default_rng((scene.seed, SHAKE_STREAM)).normal(0, 1, (scene.n_frames, 2))
    keep = float(np.exp(-1 / (SHAKE_MEMORY_S * float(scene.fps))))
    out = np.empty_like(white)
    last = white[0]
    for index, fresh in enumerate(white):
        last = last if index == 0 else keep * last + np.sqrt(1 - keep**2) * fresh
        out[index] = last
    return np.asarray(scene.shake * out)


def far_to_near(camera: Camera, boxes: Sequence[tuple[Vehicle, Array]]) -> list[tuple[Vehicle, Array]]:
    """The boxes in painter's order: what may cover another comes after it."""
    left = sorted(boxes, key=lambda item: -float(np.linalg.norm(item[1][:4].mean(axis=0) - camera.centre)))
    ordered = []
    while left:
        clear = (
            index
            for index, (_, box) in enumerate(left)
            if not any(_covers(camera, box, other) for _, other in left if other is not box)
        )
        ordered.append(left.pop(next(clear, 0)))
    return ordered


def _covers(camera: Camera, near: Array, far: Array) -> bool:
    """Whether `near` may hide a part of `far`: no wall's line parts the two with the camera on `far`'s side."""
    eye = camera.centre[:2]
    for wall, other, far_is_inside in ((far, near, True), (near, far, False)):
        ring = wall[:4, :2]
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            # the footprint runs clockwise, so its outside lies to the left of every edge
            outwards = np.array([a[1] - b[1], b[0] - a[0]])
            parts = bool(((other[:4, :2] - a) @ outwards >= 0).all())
            if parts and bool((eye - a) @ outwards < 0) == far_is_inside:
                return False
    return True


def coverage(polygon: Array, origin: tuple[int, int], shape: tuple[int, int], soft: float = 1.0) -> NDArray[np.float32]:
    """How much (0 to 1) of each pixel of the window at `origin` (u, v) px a convex polygon (N, 2) px covers.

    `soft` widens the edge's ramp to that many pixels about the same place.
    """
    hull = cv2.convexHull(polygon.astype(np.float32)).reshape(-1, 2).astype(np.float64)
    u, v = np.arange(shape[1]) + origin[0], np.arange(shape[0]) + origin[1]
    inside = np.ones(shape, np.float32)
    middle = hull.mean(axis=0)
    for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        normal = np.array([a[1] - b[1], b[0] - a[0]])
        normal *= np.sign((middle - a) @ normal) / max(float(np.linalg.norm(normal)), 1e-9)
        distance = (u - a[0])[None, :] * normal[0] + (v - a[1])[:, None] * normal[1]
        np.minimum(inside, np.clip(0.5 + distance / soft, 0, 1), out=inside, casting="same_kind")
    return inside


def window(polygon: Array, size: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """The pixels (left, top, right, bottom; ends excluded) that a polygon touches, None outside of the picture."""
    left, top = np.maximum(np.floor(polygon.min(axis=0)).astype(int) - 2, 0)
    right, bottom = np.minimum(np.ceil(polygon.max(axis=0)).astype(int) + 3, size)
    return (int(left), int(top), int(right), int(bottom)) if left < right and top < bottom else None


def _shade(picture: Image, empty: Image, scene: Scene, boxes: list[Array]) -> None:
    """Multiply the ground in the boxes' shadows, once where shadows overlap."""
    if scene.light.shadow >= 1:
        return
    deepest = np.zeros(empty.shape[:2], np.float32)
    slope = scene.light.towards / scene.light.towards[2]
    for box in boxes:
        cast = box - box[:, 2:] * slope
        if scene.camera.depth(cast).min() < NEAREST_DEPTH:
            continue
        polygon = scene.camera.project(cast)
        seen = window(polygon, scene.camera.size)
        if seen is None:
            continue
        left, top, right, bottom = seen
        part = np.s_[top:bottom, left:right]
        fresh = coverage(polygon, (left, top), (bottom - top, right - left), SOFT_PX)
        np.maximum(deepest[part], fresh, out=deepest[part])
        shade = 1 - (1 - scene.light.shadow) * deepest[part]
        picture[part] = np.rint(empty[part] * shade[..., None]).astype(np.uint8)


def draw(picture: Image, camera: Camera, light: Light, corners: Array, patches: Sequence[Patch]) -> None:
    """One vehicle over the picture, its corners (8, 3) m: silhouette exact, faces supersampled."""
    outline = camera.project(corners)
    seen = window(outline, camera.size)
    if seen is None:
        return
    left, top, right, bottom = seen
    high, wide = bottom - top, right - left
    fine = 4 if high * wide < 60_000 else 3
    canvas = np.zeros((high * fine, wide * fine, 3), np.uint8)
    shown = _lit_faces(camera, light, corners)
    for bleed in (True, False):
        for patch in patches:
            if patch.face not in shown or (bleed and not patch.base):
                continue
            pixels = camera.project(patch.points(corners))
            points = np.rint(((pixels - (left, top) + 0.5) * fine - 0.5) * 16).astype(np.int32)
            colour = [min(255.0, round(c * shown[patch.face])) for c in patch.colour]
            if bleed:
                # beyond the silhouette the face's own colour, so that averaging at the edge mixes nothing in
                cv2.polylines(canvas, [points], True, colour, 4 * fine, shift=4)
            else:
                cv2.fillConvexPoly(canvas, points, colour, shift=4)
    body_colour = cv2.resize(canvas, (wide, high), interpolation=cv2.INTER_AREA).astype(np.float32)
    alpha = coverage(outline, (left, top), (high, wide))[..., None]
    under = picture[top:bottom, left:right]
    picture[top:bottom, left:right] = np.rint(under * (1 - alpha) + body_colour * alpha).astype(np.uint8)


def _lit_faces(camera: Camera, light: Light, corners: Array) -> dict[str, float]:
    """The faces that look at the camera, with their brightness."""
    forward, leftward = corners[0] - corners[3], corners[0] - corners[1]
    axes = np.stack([forward / np.linalg.norm(forward), leftward / np.linalg.norm(leftward), np.array([0.0, 0.0, 1.0])])
    middle, half = corners.mean(axis=0), (corners[0] - corners[3], corners[0] - corners[1], corners[4] - corners[0])
    lit = {}
    for face, local in NORMALS.items():
        normal = np.array(local) @ axes
        at = middle + sum(n * side / 2 for n, side in zip(local, half, strict=True))
        if normal @ (camera.centre - at) > 0:
            lit[face] = AMBIENT + DIFFUSE * max(0.0, float(normal @ light.towards))
    return lit


def _noise_bank(scene: Scene) -> NDArray[np.int16]:
    width, height = scene.camera.size
    rng = np.random.default_rng((scene.seed, NOISE_STREAM))
    return np.rint(rng.normal(0, scene.noise, (height + MARGIN, width + MARGIN, 3))).astype(np.int16)


def _noisy(picture: Image, bank: NDArray[np.int16], seed: int, index: int) -> Image:
    """The picture with the noise bank laid over it at a place that (seed, frame) fixes."""
    du, dv = np.random.default_rng((seed, NOISE_STREAM, index)).integers(0, MARGIN, 2)
    height, width = picture.shape[:2]
    return _image(cv2.add(picture, bank[dv : dv + height, du : du + width], dtype=cv2.CV_8U))


def _image(picture: object) -> Image:
    return np.asarray(picture, dtype=np.uint8)
