"""A stereo head on wheels that looks at people in a room: footage, wheel speeds, calibration and truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from samples.casting import Figure, Plane, camera_rays, cast, clothes, exposed, wall
from samples.files import write_clip

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
TALL, FLOOR = 1.7, 1.2  # m: of a person; of the floor below the camera
ROOM = (6.0, 13.0)  # m: half the width, and the far wall
SEEN_PX = 2.0  # a target whose middle is this far inside of the left view is in truth.csv


@dataclass(frozen=True, slots=True)
class Walk:
    """A target: times (n,) s and places (n, 2) m, x to the right and z ahead; a seed for its look.

    It is there from its first time to its last.
    """

    times: Array
    places: Array
    seed: int
    width: float = 0.55
    height: float = TALL
    look: str = "patterned"

    def state(self, t: float) -> Array:
        """x, z, vx, vz (4,) at t; where it begins or ends, the nearest."""
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
    D: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)  # of both lenses
    verge: tuple[float, float, float] = (0.0, 0.0, 0.0)  # rad: rotation vector of the right camera from the left
    yaw: float = 0.0  # rad: the head looks this far to the left of where it drives
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m: [right, down, forward] of the left camera from the axle
    bob: tuple[float, float] = (0.0, 0.0)  # m and rad: how far the camera heaves and nods; poses alone tell it
    pillars: tuple[tuple[float, float, float], ...] = ()  # x, z, width m of what stands in the way

    @property
    def K(self) -> Array:
        """(3, 3) px."""
        return np.array([[self.focal, 0, self.size[0] / 2], [0, self.focal, self.size[1] / 2], [0, 0, 1]])

    @property
    def right_from_left(self) -> tuple[Array, Array]:
        """R (3, 3) and T (3,) m, x2 = R x1 + T."""
        R = cv2.Rodrigues(np.array(self.verge))[0]
        return R, R @ [-self.baseline, 0.0, 0.0]

    def wheels(self, t: Array) -> tuple[Array, Array]:
        """Left and right wheel speeds (n,) m/s."""
        v = self.speed[0] + self.speed[1] * np.sin(0.9 * t)
        w = self.turn[0] + self.turn[1] * np.sin(2 * np.pi * t / self.turn[2])
        return v - w * self.separation / 2, v + w * self.separation / 2

    def pose(self, t: Array) -> tuple[Array, Array, Array]:
        """Yaw and pitch (n,) rad and places (n, 3) m of the left camera, in its frame at 0 s, by fine integration."""
        fine = np.arange(0, float(t[-1]) + 0.002, 0.001)
        v1, v2 = self.wheels(fine)
        w, v = (v2 - v1) / self.separation, (v1 + v2) / 2
        psi = np.concatenate([[0], np.cumsum((w[1:] + w[:-1]) / 2 * 0.001)])
        mid, speed = (psi[1:] + psi[:-1]) / 2, (v[1:] + v[:-1]) / 2
        x = np.interp(t, fine, np.concatenate([[0], np.cumsum(-np.sin(mid) * speed * 0.001)]))
        z = np.interp(t, fine, np.concatenate([[0], np.cumsum(np.cos(mid) * speed * 0.001)]))
        turned = np.interp(t, fine, psi)
        right, _, ahead = self.offset
        c, s = np.cos(turned), np.sin(turned)
        x, z = x + c * right - s * ahead - right, z + s * right + c * ahead - ahead  # the lever arm
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        heave = self.bob[0] * np.sin(2.2 * t)
        return turned, self.bob[1] * np.sin(1.7 * t), np.stack([c * x + s * z, heave, c * z - s * x], axis=1)

    @property
    def times(self) -> Array:
        """(n_frames,) s."""
        return np.array([float(k / self.fps) for k in range(self.n_frames)])


def room(
    seed: int, *, people: int = 1, still: bool = False, seconds: float = 7.0, size: tuple[int, int] = (256, 220)
) -> HeadScene:
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
        size=size,
        focal=rng.uniform(210, 240) * size[0] / 256,
        baseline=rng.uniform(0.15, 0.22),
        separation=0.4,
        fps=Fraction(15),
        n_frames=int(seconds * 15),
        speed=(rng.uniform(0.1, 0.3), 0.08),
        turn=(rng.uniform(-0.03, 0.03), rng.uniform(0.05, 0.15), rng.uniform(3, 5)),
        walks=tuple(walks),
        seed=seed,
    )


def visit(seed: int, *, look: str = "patterned", size: tuple[int, int] = (256, 220)) -> HeadScene:
    """A target 3 to 6 m away that goes straight, turns by 60 to 100 degrees, later turns back, and leaves the view."""
    rng = np.random.default_rng((seed, 35))
    pace, side = rng.uniform(0.7, 1.2), 1.0 if rng.random() < 0.5 else -1.0
    near = np.array([-1.4 * side, rng.uniform(3.5, 4.0)])
    bend, radius, straight = rng.uniform(np.pi / 3, 0.55 * np.pi), rng.uniform(0.5, 0.9), rng.uniform(1.2, 1.5)
    s = np.arange(0, 14, 0.02)
    course = np.clip((s - straight) / radius, 0, bend)
    course -= np.clip((s - straight - bend * radius - 0.8) / radius, 0, bend)
    steps = 0.02 * np.stack([side * np.cos(course), np.sin(course)], axis=1)
    places = near + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)[:-1]])
    wide, high, looks = (0.6, 0.8, "box") if look == "box" else (0.55, TALL, look)
    walk = Walk(s[::25] / pace, places[::25], seed * 10, wide, high, looks)
    turn = (rng.uniform(-0.015, 0.015), rng.uniform(0.03, 0.1), rng.uniform(3, 5))
    scene = replace(room(seed, still=True, size=size), walks=(walk,), turn=turn, n_frames=int(14 / pace * 15) - 1)
    last = max((k for k, *_ in seen(scene)), default=0)
    return replace(scene, n_frames=min(last + 12, scene.n_frames))


def write_head(
    scene: HeadScene,
    out: Path,
    *,
    init: bool = False,
    crf: int = 18,
    form: str = "wheels",
    sensor_noise: float = 0.0,
    grey: bool = False,
    images: bool = False,
) -> None:
    """Write both views, calibration.yaml, sensors.csv, truth.csv and, where asked for, init.yaml.

    form: wheels (t,v1,v2), volts (t,u1,u2 at 0.25 m/s a volt) or pose (t,x,z,theta,y,pitch); sensor_noise is the
    deviation of a sample. `images` writes folders of PNG with their times instead of videos.
    """
    out.mkdir(parents=True, exist_ok=True)
    for side in ("left", "right"):
        pictures = frames(scene, side, grey)
        if images:
            _write_images(scene, out / side, pictures)
        else:
            write_clip(out / f"{side}.mp4", pictures, scene.size, scene.fps, crf)
    file = cv2.FileStorage(str(out / "calibration.yaml"), cv2.FILE_STORAGE_WRITE)
    D = np.array([scene.D])
    for name, value in (("M1", scene.K), ("D1", D), ("M2", scene.K), ("D2", D)):
        file.write(name, value)
    R, T = scene.right_from_left
    file.write("R", R)
    file.write("T", T[:, None])
    file.release()
    _write_sensors(scene, out / "sensors.csv", form, sensor_noise)
    rows = ["frame,t,id,x,y,z,vx,vy,vz"]
    for k, number, state in seen(scene):
        rows.append(f"{k},{scene.times[k]:.9f},{number}," + ",".join(f"{value:.5f}" for value in state))
    (out / "truth.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    if init:
        (out / "init.yaml").write_text("targets:\n" + "\n".join(_named(scene)) + "\n", encoding="utf-8")


def seen(scene: HeadScene) -> Iterator[tuple[int, int, Array]]:
    """Frame, target and its state x, y, z, vx, vy, vz (6,), where its middle is in the left view."""
    heads = _heads(scene)
    for k, now in enumerate(scene.times):
        for number, walk in enumerate(scene.walks, start=1):
            x, z, vx, vz = walk.state(float(now))
            point = np.array([x, FLOOR - walk.height / 2, z])
            u, v = _pixel(scene, point, heads[0][k], heads[1][k])
            inside = SEEN_PX < u < scene.size[0] - SEEN_PX and SEEN_PX < v < scene.size[1] - SEEN_PX
            if inside and walk.times[0] <= now <= walk.times[-1]:
                yield k, number, np.array([*point, vx, 0.0, vz])


def _pixel(scene: HeadScene, point: Array, R: Array, place: Array) -> Array:
    """Where the left view shows a world point (3,), distorted; NaN behind it."""
    inside = (point - place) @ R
    if inside[2] < 0.1:
        return np.full(2, np.nan)
    return np.asarray(cv2.projectPoints(inside[None], np.zeros(3), np.zeros(3), scene.K, np.array(scene.D))[0].ravel())


def _heads(scene: HeadScene) -> tuple[Array, Array]:
    """world_from_camera (n, 3, 3) of the left view, and its places (n, 3) m."""
    theta, pitch, place = scene.pose(scene.times)
    c, s, cp, sp, nil = np.cos(theta), np.sin(theta), np.cos(pitch), np.sin(pitch), 0 * theta
    right = np.stack([c, nil, s], axis=1)
    axis = np.stack([-s * cp, -sp, c * cp], axis=1)
    return np.stack([right, np.cross(axis, right), axis], axis=2), place


def _named(scene: HeadScene) -> Iterator[str]:
    """A row of init.yaml for every target, in the first frame that shows all of it."""
    turned, place = _heads(scene)
    for walk in scene.walks:
        for k, now in enumerate(scene.times):
            if now < walk.times[0]:
                continue
            x, z = walk.state(float(now))[:2]
            middle = np.array([x, FLOOR - walk.height / 2, z])
            half = np.array([[-walk.width, -walk.height], [walk.width, walk.height]]) / 2
            corners = [middle + turned[k][:, 0] * a + np.array([0, b, 0]) for a, b in half]
            low, top = (_pixel(scene, corner, turned[k], place[k]) for corner in corners)
            if np.isfinite([*low, *top]).all() and np.all(low > 0) and np.all(top < np.array(scene.size) - 1):
                w, h = top - low
                yield f"  - {{frame: {k}, left: [{low[0]:.1f}, {low[1]:.1f}, {w:.1f}, {h:.1f}]}}"
                break


def _write_sensors(scene: HeadScene, path: Path, form: str, sensor_noise: float) -> None:
    rng = np.random.default_rng((scene.seed, 36))
    t = np.arange(0, float(scene.times[-1]) + 0.04, 0.02)
    if form == "pose":
        theta, pitch, T = scene.pose(t)
        columns, names = [T[:, 0], T[:, 2], theta, T[:, 1], pitch], "t,x,z,theta,y,pitch"
    else:
        share, names = (1 / 0.25, "t,u1,u2") if form == "volts" else (1.0, "t,v1,v2")
        columns = [share * speed for speed in scene.wheels(t)]
    noisy = np.column_stack(columns) + rng.normal(0, 1, (len(t), len(columns))) * sensor_noise
    rows = [f"{a:.3f}," + ",".join(f"{value:.7f}" for value in row) for a, row in zip(t, noisy, strict=True)]
    path.write_text("\n".join([names, *rows]) + "\n", encoding="utf-8")


def _write_images(scene: HeadScene, folder: Path, pictures: Iterator[Image]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{k}.png"), picture)
    rows = [f"{k},{t:.9f}" for k, t in enumerate(scene.times)]
    (folder / "timestamps.csv").write_text("frame,t\n" + "\n".join(rows) + "\n", encoding="utf-8")


def frames(scene: HeadScene, side: str, grey: bool = False) -> Iterator[Image]:
    """One view's frames (H, W, 3) BGR, four rays to a pixel."""
    rng = np.random.default_rng((scene.seed, 32, side == "right"))
    turned, place = _heads(scene)
    R, _ = scene.right_from_left
    rays = camera_rays(scene.K, np.array(scene.D), scene.size)
    levels = [(1, FLOOR, (0, 2)), (1, FLOOR - 3.2, (0, 2)), (2, ROOM[1], (0, 1)), (0, ROOM[0], (2, 1))]
    levels += [(0, -ROOM[0], (2, 1)), (2, -ROOM[1], (0, 1))]
    planes = [Plane(*level, wall(scene.seed, k)) for k, level in enumerate(levels)]
    looks = [clothes(walk.seed, walk.look) for walk in scene.walks]
    stone = wall(scene.seed, 9)[:192, :64]
    for k, now in enumerate(scene.times):
        own = turned[k] if side == "left" else turned[k] @ R.T
        centre = place[k] + (turned[k] @ [scene.baseline, 0, 0] if side == "right" else 0)
        figures = []
        for walk, texture in zip(scene.walks, looks, strict=True):
            if walk.times[0] <= now <= walk.times[-1]:
                x, z = walk.state(float(now))[:2]
                middle = np.array([x, FLOOR - walk.height / 2, z])
                figures.append(Figure(middle, walk.width, walk.height, texture, walk.look != "box"))
        for x, z, width in scene.pillars:
            figures.append(Figure(np.array([x, FLOOR - 1.6, z]), width, 3.2, stone, False))
        picture = exposed(cast(rays @ own.T, centre, planes, figures), scene.size, scene.noise, rng)
        yield np.repeat(picture[..., 1:2], 3, axis=2) if grey else picture
