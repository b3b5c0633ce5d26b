"""The same roads in the dark: lamps that dazzle, pools of light that run ahead of them, bodies hardly or well lit.

`python -m samples.night --seed 3 --seconds 10 --ambient 0.03 --out DIR`
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from samples import ground, render
from samples.bodies import Patch, body
from samples.files import write_clip, write_scene
from samples.road import free_flow
from samples.scene import NEAREST_DEPTH, Array, Scene, Vehicle

COARSE = 4  # px: the light on the ground is smooth
LAMP_M = 0.65, 0.7  # height, and distance from the middle
REACH_M, LENGTH_M, WIDTH_M = 9.0, 6.0, 1.2  # where a beam is brightest, its length, its width close by
BEAM = 1.2  # of daylight, where a beam is brightest
GLARE_M = 0.5  # of the halo around a head lamp; a tail lamp has half of it


def frames(scene: Scene, ambient: float) -> Iterator[render.Image]:
    """The scene's frames (H, W, 3) BGR with `ambient` as the share of daylight that is left."""
    day = ground.paint(scene).astype(np.float32)
    bank = render._noise_bank(scene)
    places = _places(scene)
    drawn = {vehicle.id: _dimmed(body(vehicle, scene.seed), ambient) for vehicle in scene.vehicles}
    states = {vehicle.id: vehicle.trajectory(scene.times) for vehicle in scene.vehicles}
    dark = replace(scene.light, shadow=1.0)
    for index in range(scene.n_frames):
        boxes = [(vehicle, vehicle.corners(states[vehicle.id][index])) for vehicle in scene.vehicles]
        boxes = [(vehicle, box) for vehicle, box in boxes if scene.camera.depth(box).min() > NEAREST_DEPTH]
        light = np.full(places.shape[:2], ambient, np.float32)
        for vehicle, _ in boxes:
            light += _beam(vehicle, states[vehicle.id][index], places)
        lit = cv2.resize(light, scene.camera.size, interpolation=cv2.INTER_LINEAR)[..., None]
        picture = np.clip(day * lit, 0, 255).astype(np.uint8)
        for vehicle, corners in render.far_to_near(scene.camera, boxes):
            render.draw(picture, scene.camera, dark, corners, drawn[vehicle.id])
        glow = picture.astype(np.float32)
        for _, corners in boxes:
            _lamps(glow, scene, corners)
        yield render._noisy(np.clip(glow, 0, 255).astype(np.uint8), bank, scene.seed, index)


def _places(scene: Scene) -> Array:
    """Ground points (h, w, 2) m that every COARSE-th pixel sees; far away above the horizon."""
    width, height = scene.camera.size
    v, u = np.mgrid[0:height:COARSE, 0:width:COARSE].astype(float)
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    mapped = pixels @ np.linalg.inv(scene.camera.image_from_ground()).T
    below = mapped[..., 2] / mapped[-1, mapped.shape[1] // 2, 2] > 1e-3
    return np.where(below[..., None], mapped[..., :2] / mapped[..., 2:], 1e6)


def _dimmed(patches: list[Patch], ambient: float) -> list[Patch]:
    return [replace(patch, colour=tuple(np.multiply(patch.colour, ambient))) for patch in patches]


def _beam(vehicle: Vehicle, state: Array, places: Array) -> Array:
    """Light (h, w) of one vehicle's head lamps on the ground."""
    along = np.array([np.cos(state[2]), np.sin(state[2])])
    offset = places - (state[:2] + along * vehicle.length / 2)
    ahead, aside = offset @ along, offset @ np.array([-along[1], along[0]])
    shape = np.exp(-(((ahead - REACH_M) / LENGTH_M) ** 2) - (aside / (WIDTH_M + 0.1 * np.abs(ahead))) ** 2)
    return np.asarray(np.where(ahead > 0, BEAM * shape, 0), dtype=np.float32)


def _lamps(glow: Array, scene: Scene, corners: Array) -> None:
    """Add the lamps of one box (8, 3) m that face the camera, each with its halo."""
    front, rear = (corners[a : a + 2].mean(axis=0) for a in (0, 2))
    along = (front - rear) / np.linalg.norm(front - rear)
    across = np.array([-along[1], along[0], 0.0])
    for middle, way, size, colour in ((front, 1, 1.0, (255, 250, 240)), (rear, -1, 0.5, (40, 30, 255))):
        facing = float(way * along @ (scene.camera.centre - middle)) / np.linalg.norm(scene.camera.centre - middle)
        for side in (-1, 1):
            lamp = middle + [0, 0, LAMP_M[0]] + side * LAMP_M[1] * across
            depth = float(scene.camera.depth(lamp[None])[0])
            if facing > 0 and depth > NEAREST_DEPTH:
                (u, v), radius = scene.camera.project(lamp[None])[0], GLARE_M * size * scene.camera.K[0, 0] / depth
                _halo(glow, float(u), float(v), radius, np.array(colour) * facing)


def _halo(glow: Array, u: float, v: float, radius: float, colour: Array) -> None:
    height, width = glow.shape[:2]
    reach = 3 * radius
    left, right = int(max(0, u - reach)), int(min(width, u + reach + 1))
    top, bottom = int(max(0, v - reach)), int(min(height, v + reach + 1))
    if left < right and top < bottom:
        y, x = np.mgrid[top:bottom, left:right]
        far = ((x - u) ** 2 + (y - v) ** 2) / radius**2
        glow[top:bottom, left:right] += (2.0 * np.exp(-4 * far) + 0.4 * np.exp(-far))[..., None] * colour


def write_night(scene: Scene, out: Path, ambient: float) -> None:
    """Write a scene's files with the clip taken at night."""
    write_scene(scene, out)
    write_clip(out / "clip.mp4", frames(scene, ambient), scene.camera.size, scene.fps, 20)


def main() -> None:
    """Write one scene as the command line says."""
    parser = argparse.ArgumentParser(prog="python -m samples.night", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--size", default="1280x720", help="width x height, px")
    parser.add_argument("--ambient", type=float, default=0.03, help="share of daylight that is left")
    parser.add_argument("--out", type=Path, required=True)
    chosen = parser.parse_args()
    width, height = (int(part) for part in chosen.size.split("x"))
    write_night(free_flow(chosen.seed, chosen.seconds, (width, height)), chosen.out, chosen.ambient)


if __name__ == "__main__":
    main()
