"""A pan-tilt head above the ground that follows a walker: footage, angles, survey by gaze, calibration and truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from samples.casting import Figure, Plane, camera_rays, cast, clothes, exposed, wall
from samples.files import write_clip
from samples.head import Walk

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
SEEN_PX = 8.0


@dataclass(frozen=True, slots=True)
class GazeScene:
    """A head `above` m over the ground that looks `down` rad below the horizon at rest; walks in its x and z."""

    size: tuple[int, int]
    focal: float
    above: float
    down: float
    turned: float  # rad: the ground's axes against the head's
    moved: tuple[float, float]  # m: the head's foot on the ground
    fps: Fraction
    n_frames: int
    walks: tuple[Walk, ...]
    seed: int
    follow: bool = True  # else it rests
    lag: float = 0.15  # s by which the gaze comes late
    noise: float = 2.0
    D: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def K(self) -> Array:
        """(3, 3) px."""
        return np.array([[self.focal, 0, self.size[0] / 2], [0, self.focal, self.size[1] / 2], [0, 0, 1]])

    @property
    def times(self) -> Array:
        """(n_frames,) s."""
        return np.array([float(k / self.fps) for k in range(self.n_frames)])

    @property
    def at_rest(self) -> Array:
        """(3, 3): from the camera's axes at rest to level ones, x right, y down, z ahead."""
        return np.asarray(cv2.Rodrigues(np.array([-self.down, 0.0, 0.0]))[0])

    def angles(self, level: Array) -> Array:
        """Elevation and vergence (n, 2) rad at which level points (n, 3) m, from the head, are in the middle."""
        x, y, z = np.moveaxis(level @ self.at_rest, -1, 0)
        elevation = np.arctan2(-y, z)
        return np.stack([elevation, np.arctan2(-x, np.hypot(y, z))], axis=-1)

    def gaze(self, t: Array) -> Array:
        """Elevation and vergence (n, 2) rad over time."""
        if not self.follow:
            return np.zeros((len(t), 2))
        fine = np.arange(-0.5, float(t[-1]) + 1.0, 0.01)
        rng = np.random.default_rng((self.seed, 41))
        walk = self.walks[0]
        spots = np.array([[*walk.state(max(now - self.lag, 0.0))[:2]] for now in fine])
        level = np.column_stack([spots[:, 0], np.full(len(fine), self.above - walk.height / 2), spots[:, 1]])
        wander = gaussian_filter1d(rng.normal(0, 1, (len(fine), 2)), 30, axis=0) * 0.06
        told = gaussian_filter1d(self.angles(level), 8, axis=0) + wander
        return np.stack([np.interp(t, fine, told[:, k]) for k in (0, 1)], axis=1)

    def ground(self, spots: Array) -> Array:
        """Ground places (n, 2) m of the head's x and z (n, 2) m."""
        c, s = np.cos(self.turned), np.sin(self.turned)
        return np.asarray(spots @ np.array([[c, s], [-s, c]]) + self.moved)


def yard(seed: int, *, seconds: float = 8.0, size: tuple[int, int] = (384, 288), follow: bool = True) -> GazeScene:
    """A walker who goes straight, rounds a half circle, and comes back, 8 to 13 m before the head."""
    rng = np.random.default_rng((seed, 40))
    pace, side = rng.uniform(1.0, 1.5), 1.0 if rng.random() < 0.5 else -1.0
    radius = rng.uniform(1.3, 1.8)
    straight = max(pace * seconds - np.pi * radius, 2.0) / 2
    s = np.arange(0, pace * seconds + 2, 0.02)
    course = np.clip((s - straight) / radius, 0, np.pi)
    steps = 0.02 * np.stack([side * np.cos(course), np.sin(course)], axis=1)
    start = np.array([-side * (straight + radius) / 2, rng.uniform(8.0, 9.0)])
    places = start + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)[:-1]])
    return GazeScene(
        size=size,
        focal=rng.uniform(1.3, 1.7) * size[0] if follow else 0.95 * size[0],
        above=rng.uniform(3.5, 5.0),
        down=rng.uniform(0.3, 0.4),
        turned=rng.uniform(-np.pi, np.pi),
        moved=(rng.uniform(-20, 20), rng.uniform(-20, 20)),
        fps=Fraction(25),
        n_frames=int(25 * seconds),
        walks=(Walk(s[::25] / pace, places[::25], seed * 10 + 5),),
        seed=seed,
        follow=follow,
    )


def three(seed: int, *, size: tuple[int, int] = (384, 288)) -> GazeScene:
    """Three people before a head at rest, two towards each other and one behind them, all in line half-way."""
    rng = np.random.default_rng((seed, 44))
    side, t = 1.0 if rng.random() < 0.5 else -1.0, np.array([0, 2.5, 5.0])
    a, b, c = rng.uniform(-0.3, 0.3, 3)
    ways = [[-3, 10 + a], [0, 10.2], [3, 10.4 + a]], [[3, 11.8 + b], [0, 11.6], [-3, 11.4 + b]]
    behind = [[-1.5, 13.5 + c], [0.2, 13.3], [1.9, 12.9 + c]]
    walks = tuple(Walk(t, np.array(way) * [side, 1.0], seed * 10 + k) for k, way in enumerate((*ways, behind), start=1))
    return replace(yard(seed, seconds=5.0, size=size, follow=False), walks=walks)


def write_gaze(scene: GazeScene, out: Path, *, crf: int = 18, angle_noise: float = 0.0) -> None:
    """Write left.mp4, calibration.yaml (M1 D1), sensors.csv (t,elevation,vergence), gaze.csv and truth.csv."""
    out.mkdir(parents=True, exist_ok=True)
    write_clip(out / "left.mp4", frames(scene), scene.size, scene.fps, crf)
    file = cv2.FileStorage(str(out / "calibration.yaml"), cv2.FILE_STORAGE_WRITE)
    file.write("M1", scene.K)
    file.write("D1", np.array([scene.D]))
    file.release()
    rng = np.random.default_rng((scene.seed, 42))
    t = np.arange(0, float(scene.times[-1]) + 0.04, 0.01)
    told = scene.gaze(t) + rng.normal(0, 1, (len(t), 2)) * angle_noise
    rows = [f"{a:.3f},{e:.7f},{v:.7f}" for a, (e, v) in zip(t, told, strict=True)]
    (out / "sensors.csv").write_text("t,elevation,vergence\n" + "\n".join(rows) + "\n", encoding="utf-8")
    spots = np.stack(np.meshgrid([-4.0, 0.0, 4.0], [6.0, 10.0, 15.0]), axis=-1).reshape(-1, 2)
    looked = scene.angles(np.column_stack([spots[:, 0], np.full(len(spots), scene.above), spots[:, 1]]))
    rows = [f"{e:.6f},{v:.6f},{X:.4f},{Y:.4f}" for (e, v), (X, Y) in zip(looked, scene.ground(spots), strict=True)]
    (out / "gaze.csv").write_text("elevation,vergence,X,Y\n" + "\n".join(rows) + "\n", encoding="utf-8")
    rows = ["frame,t,id,x,y,z,vx,vy,vz", *_truth(scene)]
    (out / "truth.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def _truth(scene: GazeScene) -> Iterator[str]:
    """Where the walkers' feet are on the ground, in frames that show all of them."""
    for k, R in enumerate(_rotations(scene)):
        for number, walk in enumerate(scene.walks, start=1):
            x, z, vx, vz = walk.state(float(scene.times[k]))
            ends = np.array([[x, scene.above - walk.height, z], [x, scene.above, z]]) @ R
            pixels = ends[:, :2] / ends[:, 2:] * scene.focal + scene.K[:2, 2]
            if np.all(pixels > SEEN_PX) and np.all(pixels < np.array(scene.size) - SEEN_PX):
                X, Y = scene.ground(np.array([[x, z]]))[0]
                vX, vY = scene.ground(np.array([[vx, vz]]))[0] - scene.moved
                yield f"{k},{scene.times[k]:.9f},{number},{X:.5f},{Y:.5f},,{vX:.5f},{vY:.5f},"


def _rotations(scene: GazeScene) -> Array:
    """(n, 3, 3) from the camera's axes to level ones: elevation turns the axle that vergence turns about."""
    turns = []
    for elevation, vergence in scene.gaze(scene.times):
        tilt = cv2.Rodrigues(np.array([elevation, 0.0, 0.0]))[0]  # about x, to the right: y down turns to z ahead
        pan = cv2.Rodrigues(np.array([0.0, -vergence, 0.0]))[0]
        turns.append(scene.at_rest @ tilt @ pan)
    return np.array(turns)


def frames(scene: GazeScene) -> Iterator[Image]:
    """The frames (H, W, 3) BGR."""
    rng = np.random.default_rng((scene.seed, 43))
    rays = camera_rays(scene.K, np.array(scene.D), scene.size)
    planes = [Plane(1, scene.above, (0, 2), wall(scene.seed, 0)), Plane(2, 30.0, (0, 1), wall(scene.seed, 1))]
    looks = [clothes(walk.seed, walk.look) for walk in scene.walks]
    for now, R in zip(scene.times, _rotations(scene), strict=True):
        figures = []
        for walk, texture in zip(scene.walks, looks, strict=True):
            x, z = walk.state(float(now))[:2]
            middle = np.array([x, scene.above - walk.height / 2, z])
            figures.append(Figure(middle, walk.width, walk.height, texture, walk.look != "box"))
        yield exposed(cast(rays @ R.T, np.zeros(3), planes, figures), scene.size, scene.noise, rng)
