"""Pictures of upright figures between planes, by casting a ray through every pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Picture = NDArray[np.float32]
TEXELS = 48  # a metre
FINE = 2  # rays a pixel, each way


@dataclass(frozen=True, slots=True)
class Plane:
    """All points whose coordinate `axis` is `level` m, painted with a texture along two other axes."""

    axis: int
    level: float
    along: tuple[int, int]
    texture: Picture


@dataclass(frozen=True, slots=True)
class Figure:
    """A flat upright figure that faces the camera: its middle (3,) m, width and height m, texture, and outline."""

    middle: Array
    width: float
    height: float
    texture: Picture
    person: bool = True


def camera_rays(K: Array, D: Array, size: tuple[int, int]) -> Array:
    """Rays (FINE h, FINE w, 3) at unit depth through the parts of every pixel, lens distortion undone."""
    u, v = np.meshgrid(*((np.arange(FINE * n) + 0.5) / FINE - 0.5 for n in size))
    wanted = np.stack([u, v], axis=-1).reshape(-1, 2)
    ideal = (wanted - K[:2, 2]) / np.diag(K)[:2]
    for _ in range(30 if np.any(D) else 0):
        points = np.column_stack([ideal, np.ones(len(ideal))])
        bent = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.asarray(D, dtype=float))[0].reshape(-1, 2)
        ideal = ideal + (wanted - bent) / np.diag(K)[:2]
    return np.concatenate([ideal.reshape(*u.shape, 2), np.ones((*u.shape, 1))], axis=-1)


def cast(rays: Array, centre: Array, planes: Sequence[Plane], figures: Sequence[Figure]) -> Picture:
    """What is seen (h, w, 3) along world rays (h, w, 3) from a centre (3,) m; y points down."""
    best = np.full(rays.shape[:2], np.inf)
    picture = np.zeros((*rays.shape[:2], 3), np.float32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for plane in planes:
            depth = (plane.level - centre[plane.axis]) / rays[..., plane.axis]
            hit = centre + rays * depth[..., None]
            at = [(hit[..., a] * TEXELS).astype(np.float64) for a in plane.along]
            _paint(picture, best, depth, np.isfinite(depth), plane.texture, at, wrap=True)
        for figure in figures:
            facing = (figure.middle - centre) * [1, 0, 1]
            facing /= np.linalg.norm(facing)
            across = np.array([facing[2], 0, -facing[0]])
            depth = ((figure.middle - centre) @ facing) / (rays @ facing)
            hit = centre + rays * depth[..., None] - figure.middle
            a, b = hit @ across / (figure.width / 2), hit[..., 1] / (figure.height / 2)
            inside = (np.abs(a) < (0.95 - 0.5 * (b < -0.72) if figure.person else 1.0)) & (np.abs(b) < 1)
            high, wide = figure.texture.shape[:2]
            at = [(value + 1) / 2 * (size - 1) for value, size in ((a, wide), (b, high))]
            _paint(picture, best, depth, inside, figure.texture, at, wrap=False)
    return picture


def _paint(
    picture: Picture,
    best: Array,
    depth: Array,
    inside: NDArray[np.bool_],
    texture: Picture,
    at: list[Array],
    wrap: bool,
) -> None:
    good = inside & (depth > 0.1) & (depth < best)
    if not good.any():
        return
    size = texture.shape[:2]
    maps = [(np.mod(value[good], n) if wrap else value[good]) for value, n in zip(at, size[::-1], strict=True)]
    # one long row would be too long for remap
    rows = [np.asarray(m, np.float32) for m in maps]
    step = 30000
    seen = np.concatenate(
        [
            cv2.remap(
                texture,
                rows[0][k : k + step, None],
                rows[1][k : k + step, None],
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_WRAP if wrap else cv2.BORDER_REPLICATE,
            )
            for k in range(0, len(rows[0]), step)
        ]
    )
    picture[good], best[good] = seen[:, 0], depth[good]


def exposed(picture: Picture, size: tuple[int, int], noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The picture (h, w, 3) that a sensor of that size makes of it."""
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(small + rng.normal(0, noise, small.shape)), 0, 255).astype(np.uint8)


def wall(seed: int, number: int) -> Picture:
    """A texture of coloured squares and speckle."""
    rng = np.random.default_rng((seed, 33, number))
    coarse = rng.normal(0, 28, (32, 32, 3)) + rng.uniform(80, 170, 3)
    squares = cv2.resize(coarse.astype(np.float32), (512, 512), interpolation=cv2.INTER_NEAREST)
    return np.asarray(squares + cv2.GaussianBlur(rng.normal(0, 30, squares.shape).astype(np.float32), (0, 0), 1.5))


def clothes(seed: int, look: str = "patterned") -> Picture:
    """A person's front: head, top and trousers; patterned, plain, or the carton of a box."""
    rng = np.random.default_rng((seed, 34))
    if look == "box":
        carton = cv2.resize(
            rng.uniform(30, 230, (9, 7, 3)).astype(np.float32), (70, 90), interpolation=cv2.INTER_NEAREST
        )
        return np.asarray(cv2.GaussianBlur(carton, (0, 0), 1.0))
    texture = np.zeros((170, 55, 3), np.float32)
    parts = (
        (0, 24, np.array([150, 175, 215.0])),
        (24, 85, rng.uniform(30, 230, 3)),
        (85, 170, rng.uniform(20, 120, 3)),
    )
    for low, high, colour in parts:
        texture[low:high] = colour
    if look == "patterned":
        for _ in range(14):
            x, y = rng.integers(0, 45), rng.integers(24, 160)
            texture[y : y + rng.integers(4, 12), x : x + rng.integers(4, 14)] = rng.uniform(20, 235, 3)
    return np.asarray(cv2.GaussianBlur(texture, (0, 0), 1.0))
