"""The footage of a yard: floor, walls, shadows, bodies, noise; and its files in a scene folder."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from samples.figures import Piece
from samples.files import write_clip
from samples.people import Yard
from samples.scene import Array, Camera

Image = NDArray[np.uint8]
FLOOR_M, FLOOR_PX = 24.0, 60
"""Side of the painted floor in metres, and pixels a metre of it."""
SHADE = 0.55


def write_yard(yard: Yard, out: Path, crf: int = 23) -> None:
    """Write <camera>.mp4, calibration.toml and truth.csv (frames of the first camera) to the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    for name, camera in yard.cameras.items():
        write_clip(out / f"{name}.mp4", frames(yard, name), camera.size, yard.rates[name], crf)
    write_calibration(out / "calibration.toml", yard)
    rows = ["frame,t,id,x,y,z,vx,vy,vz"]
    first = next(iter(yard.cameras))
    t = times(yard, first)
    for walker in yard.walkers:
        for k, (x, y, vx, vy) in enumerate(walker.states(t)):
            z = yard.ground_z + walker.height / 2
            rows.append(f"{k},{t[k] - t[0]:.9f},{walker.id},{x:.4f},{y:.4f},{z:.4f},{vx:.4f},{vy:.4f},0.0")
    (out / "truth.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_calibration(path: Path, yard: Yard, turned: dict[str, Array] | None = None) -> None:
    """Write calibration.toml; `turned` names cameras whose stated rotation is off by a rotation (3, 3)."""
    tables = []
    for number, (name, camera) in enumerate(yard.cameras.items(), start=1):
        R = (turned or {}).get(name, np.eye(3)) @ camera.rotation
        rotation = cv2.Rodrigues(R)[0].ravel()
        translation = -R @ (camera.centre + [0, 0, yard.ground_z])
        tables.append(
            f'[cam_{number}]\nname = "{name}"\nsize = [{camera.size[0]}, {camera.size[1]}]\n'
            f"matrix = {camera.K.tolist()}\ndistortions = [0.0, 0.0, 0.0, 0.0, 0.0]\n"
            f"rotation = {rotation.tolist()}\ntranslation = {translation.tolist()}\n"
        )
    path.write_text("\n".join(tables), encoding="utf-8")


def times(yard: Yard, name: str) -> Array:
    """The instants (n,) s that a camera records: its clock starts when it does, `delays` after the others."""
    rate = yard.rates[name]
    count = int(yard.seconds * rate)
    return np.array([float(Fraction(k) / rate) for k in range(count)]) + yard.delays[name]


def frames(yard: Yard, name: str) -> Iterator[Image]:
    """One camera's frames (H, W, 3) BGR."""
    camera = yard.cameras[name]
    index = list(yard.cameras).index(name)
    empty = _empty(yard, camera, index)
    rng = np.random.default_rng((yard.seed, 11, index))
    grain = yard.noise * rng.standard_normal((2 * camera.size[1], 2 * camera.size[0], 3), np.float32)
    t = times(yard, name)
    states = [walker.states(t) for walker in yard.walkers]
    ways = [_ways(walker.states(np.arange(0, yard.seconds + yard.delays[name] + 1, 0.02))) for walker in yard.walkers]
    for k in range(len(t)):
        pieces: list[Piece] = []
        for walker, state, (way, heading) in zip(yard.walkers, states, ways, strict=True):
            at = min(int(t[k] / 0.02), len(way) - 1)
            pieces += walker.pieces(state[k], heading[at], way[at])
        picture = empty.copy()
        if yard.sun is not None:
            _shade(picture, camera, pieces, np.array(yard.sun))
        _draw(picture, camera, pieces)
        yield _noisy(picture, grain, rng)


def _noisy(picture: Image, grain: NDArray[np.float32], rng: np.random.Generator) -> Image:
    """The picture with a part of a larger field of noise, another one each time."""
    high, wide = picture.shape[:2]
    v, u = rng.integers(high + 1), rng.integers(wide + 1)
    noisy: Image = cv2.add(picture, grain[v : v + high, u : u + wide], dtype=cv2.CV_8U)
    return noisy


def _ways(states: Array) -> tuple[Array, Array]:
    """Way walked (n,) m and heading (n,) rad, every 0.02 s; who stands faces where the walk will go."""
    speed = np.hypot(states[:, 2], states[:, 3])
    course = np.arctan2(states[:, 3], states[:, 2])
    moving = np.flatnonzero(speed > 0.05)
    nearest = moving[np.searchsorted(moving, np.arange(len(speed))).clip(0, len(moving) - 1)] if len(moving) else [0]
    return np.cumsum(speed) * 0.02, course[nearest] if len(moving) else course


def _empty(yard: Yard, camera: Camera, index: int) -> Image:
    """The yard without people: a patched floor, and walls beyond."""
    rng = np.random.default_rng((yard.seed, 3))
    side = int(FLOOR_M * FLOOR_PX)
    patches = rng.normal(0, 16, (24, 24, 1)) + rng.normal(0, 6, (24, 24, 3))
    floor = cv2.resize(patches, (side, side), interpolation=cv2.INTER_NEAREST)
    floor += cv2.GaussianBlur(rng.normal(0, 26, (side, side, 1)).astype(np.float32), (5, 5), 0)[..., None]
    floor = yard.contrast * floor + np.array(yard.ground)
    to_floor = np.array([[1 / FLOOR_PX, 0, -FLOOR_M / 2], [0, 1 / FLOOR_PX, -FLOOR_M / 2], [0, 0, 1]])
    image_from_floor = camera.image_from_ground() @ to_floor
    wide, high = camera.size
    walls = np.random.default_rng((yard.seed, 5, index))
    blocks = yard.contrast * walls.normal(0, 25, (6, 8, 3)) + np.array([150.0, 140.0, 130.0])
    picture = cv2.resize(blocks.astype(np.float32), (wide, high), interpolation=cv2.INTER_LINEAR)
    picture += (
        yard.contrast * cv2.GaussianBlur(walls.normal(0, 18, (high, wide, 1)).astype(np.float32), (5, 5), 0)[..., None]
    )
    u, v = np.meshgrid(np.arange(wide), np.arange(high))
    floor_from_image = np.linalg.inv(image_from_floor)
    depth = floor_from_image[2, 0] * u + floor_from_image[2, 1] * v + floor_from_image[2, 2]
    sign = np.sign(floor_from_image[2] @ np.linalg.solve(floor_from_image, [side / 2, side / 2, 1.0]))
    size, flags = (wide, high), cv2.INTER_AREA | cv2.WARP_INVERSE_MAP
    laid = cv2.warpPerspective(floor.astype(np.float32), floor_from_image, size, flags=flags)
    covered = cv2.warpPerspective(np.ones((side, side), np.float32), floor_from_image, size, flags=flags)
    covered = np.where(depth * sign > 0, covered, 0)[..., None]
    return np.clip(picture * (1 - covered) + laid * covered, 0, 255).astype(np.uint8)


def _fill(picture: NDArray[np.uint8], outline: Array, colour: tuple[float, ...]) -> None:
    points = np.rint(np.clip(outline, -2000, 4000) * 16).astype(np.int32)
    cv2.fillConvexPoly(picture, points, colour, cv2.LINE_AA, 4)


def _draw(picture: Image, camera: Camera, pieces: list[Piece]) -> None:
    """Bodies, far pieces first; each lighter to its upper left."""
    far = [(camera.depth(piece.ends()), piece) for piece in pieces]
    for _, piece in sorted(((d.mean(), piece) for d, piece in far if d.min() > 0.5), key=lambda pair: -pair[0]):
        outline = piece.outline(camera)
        _fill(picture, outline, piece.colour)
        middle = outline.mean(axis=0)
        light = tuple(min(255.0, 1.15 * c + 8) for c in piece.colour)
        _fill(picture, middle + 0.55 * (outline - middle) - 0.15 * np.ptp(outline, axis=0), light)


def _shade(picture: Image, camera: Camera, pieces: list[Piece], sun: Array) -> None:
    """Darken the floor where a body keeps the sun off."""
    mask = np.zeros(picture.shape[:2], np.uint8)
    for cast in (piece.cast(sun) for piece in pieces):
        if camera.depth(cast).min() > 0.5:
            _fill(mask, cv2.convexHull(camera.project(cast).astype(np.float32)).reshape(-1, 2), (255,))
    soft = cv2.GaussianBlur(mask, (5, 5), 0).astype(np.float32)[..., None] / 255
    np.copyto(picture, np.rint(picture * (1 - (1 - SHADE) * soft)).astype(np.uint8))
