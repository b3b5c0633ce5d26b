"""A vehicle's front that comes towards a static stereo pair: footage, calibration, quads, path and truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from samples.files import write_clip

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
MPH = 0.44704


@dataclass(frozen=True, slots=True)
class Pass:
    """One vehicle: speed m/s, where its front's middle begins (3,) m, course (rad, 0: straight at the camera), turning
    radius (m, 0: straight; positive: to the vehicle's left), size of the front (w, h) m, texture seed.
    """

    speed: float
    start: Array
    course: float
    radius: float
    size: tuple[float, float]
    seed: int

    def pose(self, t: float) -> tuple[Array, float]:
        """The front's middle (3,) m and the course (rad) at t (s)."""
        way = self.speed * t
        if self.radius == 0:
            return self.start + way * heading(self.course), self.course
        turned = self.course + way / self.radius
        # x' = sin(course), z' = -cos(course)
        shift = self.radius * np.array(
            [-np.cos(turned) + np.cos(self.course), 0, -np.sin(turned) + np.sin(self.course)]
        )
        return self.start + shift, turned

    def corners(self, t: float) -> Array:
        """The front's corners (4, 3) m as the camera sees them, clockwise from the top left."""
        middle, course = self.pose(t)
        side = np.array([np.cos(course), 0, np.sin(course)])
        up = np.array([0, -1.0, 0])
        w, h = self.size[0] / 2, self.size[1] / 2
        return np.stack([middle + a * w * side + b * h * up for a, b in ((-1, 1), (1, 1), (1, -1), (-1, -1))])


def heading(course: float) -> Array:
    """The unit vector (3,) of a course: 0 runs towards the camera, against z."""
    return np.array([np.sin(course), 0.0, -np.cos(course)])


@dataclass(frozen=True, slots=True)
class PassScene:
    """Cameras, vehicles, rate and noise of a scene; x_right = R x_left + T."""

    K: Array
    R: Array
    T: Array
    size: tuple[int, int]
    passes: tuple[Pass, ...]
    fps: Fraction
    n_frames: int
    seed: int
    camera_height: float = 1.4
    noise: float = 2.0


def straight_pass(seed: int, *, mph: float | None = None, noise: float = 2.0, radius: float = 0.0) -> PassScene:
    """A front that comes from about 80 m to 25 m, before a pair 0.5 m apart."""
    rng = np.random.default_rng((seed, 21))
    speed = MPH * (rng.uniform(25, 60) if mph is None else mph)
    f = rng.uniform(2100, 2300)
    K = np.array([[f, 0, 512.0], [0, f, 384.0], [0, 0, 1.0]])
    R = cv2.Rodrigues(rng.normal(0, 0.004, 3))[0] @ np.eye(3)
    T = np.array([-0.5, 0.0, 0.0]) + rng.normal(0, 0.004, 3)
    size = (rng.uniform(1.5, 1.9), rng.uniform(1.1, 1.5))
    height = rng.uniform(1.2, 1.8)
    lane = rng.uniform(2.0, 6.0) * (1 if rng.random() < 0.5 else -1)
    course = rng.normal(0, 0.02) - np.sign(lane) * 0.02
    first, last = rng.uniform(76, 82), rng.uniform(25, 30)
    start = np.array([lane - (first - 25) * np.sin(course), height - size[1] / 2 - 0.25, first])
    if radius:
        course = -np.sign(radius) * 0.35
        first = 62.0
        start = np.array([rng.uniform(-2, 2) + np.sign(radius) * 5, start[1], first])
    rate = Fraction(5)
    way = (first - last) * (1.0 if not radius else 0.95)
    n = int(way / speed * float(rate)) + 1
    return PassScene(
        K, R, T, (1024, 768), (Pass(speed, start, course, radius, size, seed),), rate, n, seed, height, noise
    )


def write_pass(scene: PassScene, out: Path, *, init: bool = True, path: bool = True, crf: int = 20) -> None:
    """Write left.mp4, right.mp4, calibration.yaml, truth.csv and, where asked for, init.yaml and path.yaml."""
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng((scene.seed, 22))
    for side in ("left", "right"):
        write_clip(out / f"{side}.mp4", frames(scene, side), scene.size, scene.fps, crf)
    write_calibration(out / "calibration.yaml", scene)
    rows = ["frame,t,id,x,y,z,vx,vy,vz"]
    for k in range(scene.n_frames):
        t = float(k / scene.fps)
        for number, each in enumerate(scene.passes, start=1):
            p, course = each.pose(t)
            v = each.speed * heading(course)
            rows.append(f"{k},{t:.9f},{number}," + ",".join(f"{x:.5f}" for x in (*p, *v)))
    (out / "truth.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    if init:
        targets = []
        for each in scene.passes:
            quads = {s: project(scene, each.corners(0.0), s) + rng.normal(0, 0.4, (4, 2)) for s in ("left", "right")}
            text = ", ".join(f"{s}: {np.round(q, 2).tolist()}" for s, q in quads.items())
            targets.append(f"  - {{frame: 0, {text}, speed: {each.speed * rng.choice([0.87, 1.13]):.3f}}}")
        (out / "init.yaml").write_text("targets:\n" + "\n".join(targets) + "\n", encoding="utf-8")
    if path:
        each = scene.passes[0]
        end = float(scene.n_frames / scene.fps)
        times = np.linspace(-0.1, end, 2 if each.radius == 0 else 9)
        way = np.stack([each.pose(t)[0] for t in times]) + [0, each.size[1] / 2 + 0.2, 0]
        lines = []
        for side in ("left", "right"):
            seen = project(scene, way, side) + rng.normal(0, 0.05, (len(way), 2))
            lines.append(f"{side}: {np.round(seen, 3).tolist()}")
        (out / "path.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_calibration(path: Path, scene: PassScene) -> None:
    """OpenCV FileStorage with M1 D1 M2 D2 R T."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("M1", scene.K), ("D1", np.zeros((1, 5))), ("M2", scene.K), ("D2", np.zeros((1, 5)))):
        file.write(name, value)
    file.write("R", scene.R)
    file.write("T", scene.T.reshape(3, 1))
    file.release()


def project(scene: PassScene, points: Array, side: str) -> Array:
    """Pixels (n, 2) of points (n, 3) of the left camera's frame."""
    seen = points if side == "left" else points @ scene.R.T + scene.T
    pixels = seen @ scene.K.T
    return np.asarray(pixels[:, :2] / pixels[:, 2:])


def frames(scene: PassScene, side: str) -> Iterator[Image]:
    """One view's frames (H, W, 3) BGR."""
    rng = np.random.default_rng((scene.seed, 23, side == "right"))
    empty = _empty(scene, side)
    textures = [_texture(each) for each in scene.passes]
    for k in range(scene.n_frames):
        t = float(k / scene.fps)
        picture = empty.copy()
        order = sorted(range(len(scene.passes)), key=lambda i: -scene.passes[i].pose(t)[0][2])
        for i in order:
            _lay(picture, textures[i], project(scene, scene.passes[i].corners(t), side))
        yield np.clip(np.rint(picture + rng.normal(0, scene.noise, picture.shape)), 0, 255).astype(np.uint8)


def _texture(each: Pass) -> NDArray[np.float32]:
    """A painted front: body colour, windscreen, grille, lamps, plate, dirt."""
    rng = np.random.default_rng((each.seed, 24))
    wide, high = 512, 384
    body = rng.uniform(40, 220, 3)
    front = np.tile(body, (high, wide, 1)).astype(np.float32)
    front += 10 * cv2.GaussianBlur(rng.normal(0, 6, (high, wide, 1)).astype(np.float32), (0, 0), 9)[..., None]

    def fill(x0: float, y0: float, x1: float, y1: float, colour: tuple[float, ...]) -> None:
        cv2.rectangle(
            front, (int(x0 * wide), int(y0 * high)), (int(x1 * wide), int(y1 * high)), tuple(map(float, colour)), -1
        )

    fill(0.1, 0.05, 0.9, 0.4, tuple(rng.uniform(20, 70, 3)))
    fill(0.3, 0.55, 0.7, 0.72, tuple(rng.uniform(15, 50, 3)))
    for x in (0.05, 0.77):
        fill(x, 0.52, x + 0.18, 0.68, tuple(rng.uniform(200, 250, 3)))
    fill(0.4, 0.78, 0.6, 0.86, (235, 235, 235))
    fill(0.0, 0.9, 1.0, 1.0, tuple(rng.uniform(10, 40, 3)))
    for _ in range(25):
        x, y = rng.uniform(0, 0.95, 2)
        fill(x, y, x + rng.uniform(0.01, 0.06), y + rng.uniform(0.01, 0.05), tuple(body * rng.uniform(0.5, 1.4)))
    return front


def _lay(picture: Image, texture: NDArray[np.float32], quad: Array) -> None:
    """Draw a texture onto a quad (4, 2) px, averaged over each pixel."""
    over = 4
    low = np.floor(quad.min(axis=0)).astype(int) - 2
    top = np.ceil(quad.max(axis=0)).astype(int) + 3
    low, top = np.maximum(low, 0), np.minimum(top, [picture.shape[1], picture.shape[0]])
    if np.any(top - low < 2):
        return
    high, wide = texture.shape[:2]
    corners = np.array([[-0.5, -0.5], [wide - 0.5, -0.5], [wide - 0.5, high - 0.5], [-0.5, high - 0.5]], np.float32)
    fine = ((quad - low + 0.5) * over - 0.5).astype(np.float32)
    size = tuple(int(n) for n in (top - low) * over)
    H = cv2.getPerspectiveTransform(corners, fine)
    # A texture finer than the picture is blurred to its scale first.
    shrink = wide / max(float(np.linalg.norm(quad[1] - quad[0])) * over, 1.0)
    soft = cv2.GaussianBlur(texture, (0, 0), 0.4 * shrink) if shrink > 1.2 else texture
    laid = cv2.warpPerspective(soft, H, size, flags=cv2.INTER_LINEAR)
    share = cv2.warpPerspective(np.ones((high, wide), np.float32), H, size, flags=cv2.INTER_LINEAR)
    small = (int(top[0] - low[0]), int(top[1] - low[1]))
    laid = cv2.resize(laid * share[..., None], small, interpolation=cv2.INTER_AREA)
    share = cv2.resize(share, small, interpolation=cv2.INTER_AREA)[..., None]
    part = picture[low[1] : top[1], low[0] : top[0]]
    np.copyto(part, np.rint(part * (1 - share) + laid).clip(0, 255).astype(np.uint8))


def _empty(scene: PassScene, side: str) -> Image:
    """Sky, far trees, and a road that runs away from the cameras."""
    wide, high = scene.size
    rng = np.random.default_rng((scene.seed, 25))
    band = rng.normal(0, 22, (high // 6, wide // 3 + 40, 3)) + 110.0
    far = cv2.resize(band.astype(np.float32), (wide + 120, high), interpolation=cv2.INTER_CUBIC)
    # What is far away is seen by the right camera as if it had only turned.
    turned = np.eye(3) if side == "left" else scene.K @ scene.R @ np.linalg.inv(scene.K)
    move = turned @ np.array([[1, 0, -60.0], [0, 1, 0], [0, 0, 1]])
    border = cv2.BORDER_REFLECT
    picture = cv2.warpPerspective(far, move, scene.size, flags=cv2.INTER_LINEAR, borderMode=border)
    patches = rng.normal(0, 14, (160, 80, 1)) + 105.0
    road = cv2.resize(patches.astype(np.float32), (640, 1280), interpolation=cv2.INTER_LINEAR)
    road += rng.normal(0, 9, road.shape).astype(np.float32)
    road[:, 310:318] = 210
    ground = np.array([[-16, 5], [16, 5], [16, 165], [-16, 165]], dtype=float)
    points = np.column_stack([ground[:, 0], np.full(4, scene.camera_height), ground[:, 1]])
    corners = np.array([[0, 0], [639, 0], [639, 1279], [0, 1279]], np.float32)
    H = cv2.getPerspectiveTransform(corners, project(scene, points, side).astype(np.float32))
    flags = cv2.INTER_LINEAR
    laid = cv2.warpPerspective(np.repeat(road[..., None], 3, axis=2), H, scene.size, flags=flags)
    share = cv2.warpPerspective(np.ones(road.shape, np.float32), H, scene.size, flags=flags)[..., None]
    return np.clip(picture * (1 - share) + laid * share, 0, 255).astype(np.uint8)
