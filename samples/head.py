"""A stereo head on wheels that looks at people in a room: footage, wheel speeds, calibration and truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from samples.files import write_clip

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
TALL, FLOOR = 1.7, 1.2  # m: of a person; of the floor below the camera
ROOM = (6.0, 13.0)  # m: half the width, and the far wall
TEXELS = 48  # a metre


@dataclass(frozen=True, slots=True)
class Walk:
    """A person: times (n,) s and places (n, 2) m, x to the right and z ahead; a seed for the clothes."""

    times: Array
    places: Array
    seed: int
    width: float = 0.55

    def state(self, t: float) -> Array:
        """x, z, vx, vz (4,) at t."""
        curve = CubicSpline(self.times, self.places)
        when = float(np.clip(t, self.times[0], self.times[-1]))
        return np.concatenate([curve(when), curve(when, 1) if when == t else np.zeros(2)])


@dataclass(frozen=True, slots=True)
class HeadScene:
    """Cameras, wheels, people: speed and turning rate of the head are sums of slow waves."""

    size: tuple[int, int]
    focal: float
    baseline: float
    separation: float
    fps: Fraction
    n_frames: int
    speed: tuple[float, float]  # mean m/s, and how far it swings
    turn: tuple[float, float, float]  # rad/s: mean, swing, and period s of it
    walks: tuple[Walk, ...]
    seed: int
    noise: float = 2.0

    @property
    def K(self) -> Array:
        """(3, 3) px."""
        return np.array([[self.focal, 0, self.size[0] / 2], [0, self.focal, self.size[1] / 2], [0, 0, 1]])

    def wheels(self, t: Array) -> tuple[Array, Array]:
        """Left and right wheel speeds (n,) m/s."""
        v = self.speed[0] + self.speed[1] * np.sin(0.9 * t)
        w = self.turn[0] + self.turn[1] * np.sin(2 * np.pi * t / self.turn[2])
        return v - w * self.separation / 2, v + w * self.separation / 2

    def pose(self, t: Array) -> tuple[Array, Array]:
        """Yaw (n,) rad and places (n, 3) m of the left camera, by fine integration."""
        fine = np.arange(0, float(t[-1]) + 0.002, 0.001)
        v1, v2 = self.wheels(fine)
        w, v = (v2 - v1) / self.separation, (v1 + v2) / 2
        theta = np.concatenate([[0], np.cumsum((w[1:] + w[:-1]) / 2 * 0.001)])
        mid, speed = (theta[1:] + theta[:-1]) / 2, (v[1:] + v[:-1]) / 2
        x = np.concatenate([[0], np.cumsum(-np.sin(mid) * speed * 0.001)])
        z = np.concatenate([[0], np.cumsum(np.cos(mid) * speed * 0.001)])
        return np.interp(t, fine, theta), np.stack([np.interp(t, fine, x), 0 * t, np.interp(t, fine, z)], axis=1)

    @property
    def times(self) -> Array:
        """(n_frames,) s."""
        return np.array([float(k / self.fps) for k in range(self.n_frames)])


def room(seed: int, *, people: int = 1, still: bool = False, seconds: float = 7.0) -> HeadScene:
    """One person who goes straight and then turns (or two who cross), before a head that drives and turns."""
    rng = np.random.default_rng((seed, 31))
    way = rng.uniform(0.75, 1.1)
    side = 1.0 if rng.random() < 0.5 else -1.0
    walks = []
    for number in range(0 if still else people):
        s = side if number == 0 else -side
        start = np.array([-1.5 * s, rng.uniform(4.2, 4.8) + 0.8 * number])
        half = 0.5 * seconds
        middle = start + np.array([s * way, 0.15]) * half
        if people > 1:
            end = middle + np.array([s * way, 0.1]) * half
        else:
            end = middle + np.array([0.15 * s, way]) * half
        quarter = start + (middle - start) * 0.5
        after = middle + (end - middle) * 0.5
        times = np.array([0, 0.25, 0.5, 0.75, 1.0]) * seconds
        walks.append(Walk(times, np.stack([start, quarter, middle, after, end]), seed * 10 + number))
    return HeadScene(
        size=(256, 220),
        focal=rng.uniform(210, 240),
        baseline=rng.uniform(0.15, 0.22),
        separation=0.4,
        fps=Fraction(15),
        n_frames=int(seconds * 15),
        speed=(rng.uniform(0.1, 0.3), 0.08),
        turn=(rng.uniform(-0.03, 0.03), rng.uniform(0.05, 0.15), rng.uniform(3, 5)),
        walks=tuple(walks),
        seed=seed,
    )


def write_head(scene: HeadScene, out: Path, *, init: bool = False, crf: int = 18) -> None:
    """Write left.mp4, right.mp4, calibration.yaml, sensors.csv (t,v1,v2), truth.csv and, where asked for, init.yaml."""
    out.mkdir(parents=True, exist_ok=True)
    for side in ("left", "right"):
        write_clip(out / f"{side}.mp4", frames(scene, side), scene.size, scene.fps, crf)
    file = cv2.FileStorage(str(out / "calibration.yaml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (("M1", scene.K), ("D1", np.zeros((1, 5))), ("M2", scene.K), ("D2", np.zeros((1, 5)))):
        file.write(name, value)
    file.write("R", np.eye(3))
    file.write("T", np.array([[-scene.baseline], [0.0], [0.0]]))
    file.release()
    t = np.arange(0, float(scene.times[-1]) + 0.04, 0.02)
    v1, v2 = scene.wheels(t)
    rows = [f"{a:.3f},{b:.6f},{c:.6f}" for a, b, c in zip(t, v1, v2, strict=True)]
    (out / "sensors.csv").write_text("t,v1,v2\n" + "\n".join(rows) + "\n", encoding="utf-8")
    rows = ["frame,t,id,x,y,z,vx,vy,vz"]
    for k, now in enumerate(scene.times):
        for number, walk in enumerate(scene.walks, start=1):
            x, z, vx, vz = walk.state(float(now))
            rows.append(f"{k},{now:.9f},{number},{x:.5f},{FLOOR - TALL / 2:.5f},{z:.5f},{vx:.5f},0,{vz:.5f}")
    (out / "truth.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    if init:
        entries = []
        for walk in scene.walks:
            x, z = walk.state(0.0)[:2]
            u, v = scene.size[0] / 2 + scene.focal * x / z, scene.size[1] / 2 + scene.focal * (FLOOR - TALL / 2) / z
            w, h = scene.focal * walk.width / z, scene.focal * TALL / z
            entries.append(f"  - {{frame: 0, left: [{u - w / 2:.1f}, {v - h / 2:.1f}, {w:.1f}, {h:.1f}]}}")
        (out / "init.yaml").write_text("targets:\n" + "\n".join(entries) + "\n", encoding="utf-8")


def frames(scene: HeadScene, side: str) -> Iterator[Image]:
    """One view's frames (H, W, 3) BGR, by casting a ray through every pixel, four to a pixel."""
    rng = np.random.default_rng((scene.seed, 32, side == "right"))
    theta, place = scene.pose(scene.times)
    wide, high = scene.size
    u, v = np.meshgrid((np.arange(2 * wide) + 0.5) / 2 - 0.5, (np.arange(2 * high) + 0.5) / 2 - 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(scene.K).T
    walls = [_wall(scene.seed, k) for k in range(5)]
    clothes = [_clothes(walk.seed) for walk in scene.walks]
    for k, now in enumerate(scene.times):
        c, s = np.cos(theta[k]), np.sin(theta[k])
        R = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        centre = place[k] + (R @ [scene.baseline, 0, 0] if side == "right" else 0)
        picture = _cast(rays @ R.T, centre, walls, [walk.state(float(now)) for walk in scene.walks], scene, clothes)
        small = cv2.resize(picture, scene.size, interpolation=cv2.INTER_AREA)
        yield np.clip(np.rint(small + rng.normal(0, scene.noise, small.shape)), 0, 255).astype(np.uint8)


def _cast(
    rays: Array, centre: Array, walls: list[Array], people: list[Array], scene: HeadScene, clothes: list[Array]
) -> NDArray[np.float32]:
    best = np.full(rays.shape[:2], np.inf)
    picture = np.zeros((*rays.shape[:2], 3), np.float32)
    planes = [
        (1, FLOOR, (0, 2)),
        (1, FLOOR - 3.2, (0, 2)),
        (2, ROOM[1], (0, 1)),
        (0, ROOM[0], (2, 1)),
        (0, -ROOM[0], (2, 1)),
    ]
    for texture, (axis, level, along) in zip(walls, planes, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (level - centre[axis]) / rays[..., axis]
        hit = centre + rays * depth[..., None]
        good = (depth > 0.1) & (depth < best) & np.isfinite(depth)
        at = [np.mod((hit[..., a] * TEXELS), texture.shape[0]).astype(np.float32) for a in along]
        seen = cv2.remap(texture, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        picture[good], best[good] = seen[good], depth[good]
    for (x, z, *_), texture, walk in zip(people, clothes, scene.walks, strict=True):
        facing = np.array([x - centre[0], 0, z - centre[2]])
        facing /= np.linalg.norm(facing)
        across = np.array([facing[2], 0, -facing[0]])
        middle = np.array([x, FLOOR - TALL / 2, z])
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = ((middle - centre) @ facing) / (rays @ facing)
        hit = centre + rays * depth[..., None] - middle
        a, b = hit @ across / (walk.width / 2), hit[..., 1] / (TALL / 2)
        body = (np.abs(a) < 0.95 - 0.35 * (b > 0.1) * 0 - 0.5 * (b < -0.72)) & (np.abs(b) < 1)
        good = body & (depth > 0.1) & (depth < best)
        high, wide = texture.shape[:2]
        at = [((value + 1) / 2 * (size - 1)).astype(np.float32) for value, size in ((a, wide), (b, high))]
        seen = cv2.remap(texture, at[0], at[1], cv2.INTER_LINEAR)
        picture[good], best[good] = seen[good], depth[good]
    return picture


def _wall(seed: int, number: int) -> Array:
    rng = np.random.default_rng((seed, 33, number))
    coarse = rng.normal(0, 28, (32, 32, 3)) + rng.uniform(80, 170, 3)
    wall = cv2.resize(coarse.astype(np.float32), (512, 512), interpolation=cv2.INTER_NEAREST)
    return wall + cv2.GaussianBlur(rng.normal(0, 30, wall.shape).astype(np.float32), (0, 0), 1.5)


def _clothes(seed: int) -> Array:
    rng = np.random.default_rng((seed, 34))
    texture = np.zeros((170, 55, 3), np.float32)
    for low, high, colour in (
        (0, 24, (150, 175, 215)),
        (24, 85, rng.uniform(30, 230, 3)),
        (85, 170, rng.uniform(20, 120, 3)),
    ):
        texture[low:high] = colour
    for _ in range(14):
        x, y = rng.integers(0, 45), rng.integers(24, 160)
        texture[y : y + rng.integers(4, 12), x : x + rng.integers(4, 14)] = rng.uniform(20, 235, 3)
    return cv2.GaussianBlur(texture, (0, 0), 1.0)
