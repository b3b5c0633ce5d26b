"""What a scene is: a camera over a road, vehicles with exact trajectories, light; and what follows from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Trajectory = Callable[[Array], Array]
"""Times (n,) s -> states (n, 5): x, y (m, middle of the footprint), theta (rad, heading), vx, vy (m/s)."""

NEAREST_DEPTH = 1.5
"""Metres: a vehicle with a corner nearer than this lies outside every picture these cameras take."""

# Corners 0-3 on the ground: front left, front right, rear right, rear left; 4-7 above them.
# A face runs bottom-a, bottom-b, top-b, top-a; the sides and the roof from the rear to the front.
FACES = {
    "front": (1, 0, 4, 5),
    "rear": (3, 2, 6, 7),
    "left": (3, 0, 4, 7),
    "right": (2, 1, 5, 6),
    "roof": (7, 4, 5, 6),
}
NORMALS = {"front": (1, 0, 0), "rear": (-1, 0, 0), "left": (0, 1, 0), "right": (0, -1, 0), "roof": (0, 0, 1)}


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole: K (3, 3) px, rotation camera_from_world (3, 3), centre (3,) m, size (width, height) px."""

    K: Array
    rotation: Array
    centre: Array
    size: tuple[int, int]

    def depth(self, points: Array) -> Array:
        """Depths (N,) m along the optical axis of world points (N, 3)."""
        return np.asarray((points - self.centre) @ self.rotation[2])

    def project(self, points: Array) -> Array:
        """Pixels (N, 2) of world points (N, 3) m."""
        rays = (points - self.centre) @ (self.K @ self.rotation).T
        return np.asarray(rays[:, :2] / rays[:, 2:])

    def image_from_ground(self) -> Array:
        """The homography (3, 3) from the plane Z = 0 (m) to pixels."""
        R = self.rotation
        return np.asarray(self.K @ np.column_stack([R[:, 0], R[:, 1], -R @ self.centre]))


@dataclass(frozen=True, slots=True)
class Placement:
    """Where the road's frame (x right, y along, m) lies in the world: turned by `angle` (rad), then moved (2,) m."""

    angle: float
    offset: Array

    @property
    def rotation(self) -> Array:
        """world_from_road (2, 2)."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[c, -s], [s, c]])

    def matrix(self) -> Array:
        """world_from_road (3, 3), homogeneous."""
        matrix = np.eye(3)
        matrix[:2, :2], matrix[:2, 2] = self.rotation, self.offset
        return matrix

    def points(self, points: Array) -> Array:
        """World points (N, 2) of points (N, 2) in the road's frame."""
        return np.asarray(points @ self.rotation.T + self.offset)

    def trajectory(self, on_road: Trajectory) -> Trajectory:
        """The same drive in the world."""

        def in_world(t: Array) -> Array:
            states = on_road(t)
            position, velocity = self.points(states[:, :2]), states[:, 3:] @ self.rotation.T
            return np.column_stack([position, states[:, 2] + self.angle, velocity])

        return in_world


@dataclass(frozen=True, slots=True)
class Light:
    """The sun: `towards` (3,) unit vector from the ground to it; the share of light in a shadow (1: no shadows)."""

    towards: Array
    shadow: float = 0.55


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A box on wheels: sizes in m, colour BGR."""

    id: int
    kind: str
    length: float
    width: float
    height: float
    colour: tuple[int, int, int]
    trajectory: Trajectory

    def corners(self, state: Array) -> Array:
        """The box's corners (8, 3) m for one state (5,): the ground's four, then the roof's."""
        along, across = np.array([1, 1, -1, -1]) * self.length / 2, np.array([1, -1, -1, 1]) * self.width / 2
        c, s = np.cos(state[2]), np.sin(state[2])
        footprint = np.column_stack([state[0] + c * along - s * across, state[1] + s * along + c * across])
        low, high = np.zeros((4, 1)), np.full((4, 1), self.height)
        return np.vstack([np.hstack([footprint, low]), np.hstack([footprint, high])])


@dataclass(frozen=True, slots=True)
class Road:
    """The road in its own frame: lanes as (middle x m, +1 away or -1 towards the camera), widths and lines in m."""

    lanes: tuple[tuple[float, int], ...]
    lane_width: float
    crossing: tuple[float, float] | None = None
    stop_lines: tuple[tuple[float, int], ...] = ()

    @property
    def edges(self) -> tuple[float, float]:
        """Left and right border x, m."""
        middles = [x for x, _ in self.lanes]
        return min(middles) - self.lane_width / 2, max(middles) + self.lane_width / 2


@dataclass(frozen=True, slots=True)
class Scene:
    """All that determines the frames: rendering draws nothing at random that `seed` does not fix."""

    camera: Camera
    placement: Placement
    road: Road
    vehicles: tuple[Vehicle, ...]
    light: Light
    fps: Fraction
    n_frames: int
    seed: int
    noise: float = 2.0
    """Sensor noise, grey levels rms."""
    shake: float = 0.0
    """Camera shake, px rms in u and in v."""
    times: Array = field(init=False)
    """(n_frames,) s."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", np.array([float(i / self.fps) for i in range(self.n_frames)]))


def share_inside(camera: Camera, corners: Array) -> float:
    """How much (0 to 1) of the upright rectangle around the projected corners (8, 3) lies inside the picture."""
    if camera.depth(corners).min() < NEAREST_DEPTH:
        return 0.0
    pixels = camera.project(corners)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    # pixel centres are at integers: the picture reaches half a pixel beyond the outer centres
    seen = np.minimum(high, np.array(camera.size) - 0.5) - np.maximum(low, -0.5)
    return float(np.prod(np.maximum(seen, 0.0)) / np.prod(high - low))
