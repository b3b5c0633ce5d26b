"""A vehicle's front: its shape, where it stands in a state, what was seen of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from visfuse_cli.facing import free
from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.maths import particles
from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import in_right, on_plane, projected, triangulated
from visfuse_cli.records import Array, Gaussian, StereoRig
from visfuse_cli.vision import patches
from visfuse_cli.vision.patches import Grey, Template
from visfuse_cli.vision.pieces import Pieces, Seen

S, V, LATERAL, VERTICAL, SIZE = range(5)  # of a state: arc length m, speed m/s, drift m, log size
NEAREST = 0.1  # m before the cameras
FACING, FACING_FOUND = 0.4, 0.97  # cosines of the way to the line of sight from which on its front is seen


@dataclass(frozen=True, slots=True)
class Shape:
    """The front: corners (4, 3) m along the path, to the right of it and up, from its middle, at log size 0."""

    corners: Array

    def points(self, way: Way, states: Array) -> Array:
        """Corners (..., 4, 3) m of states (..., 5)."""
        point, axes = way.frame(states[..., S])
        middle = point + states[..., LATERAL, None] * axes[..., 1] + states[..., VERTICAL, None] * axes[..., 2]
        scaled = np.exp(states[..., SIZE])[..., None, None] * self.corners
        return np.asarray(middle[..., None, :] + scaled @ np.swapaxes(axes, -1, -2))


def middle(way: Way, states: Array) -> Array:
    """The front's middle (..., 3) m of states (..., 5)."""
    point, axes = way.frame(states[..., S])
    return np.asarray(point + states[..., LATERAL, None] * axes[..., 1] + states[..., VERTICAL, None] * axes[..., 2])


def place_of(rig: StereoRig, left: Array, right: Array) -> Array | None:
    """Where (3,) m the middle of a front in both quads (4, 2) px is; None where that is not before the cameras."""
    place = triangulated(rig, left.mean(axis=0), right.mean(axis=0))
    return place if np.isfinite(place).all() and place[2] > NEAREST else None


def shape_of(rig: StereoRig, way: Way, quad: Array, depth: float, facing: float) -> tuple[Shape, Array]:
    """The front in a left quad (4, 2) px whose middle is `depth` (m) away, and its state (5,).

    It faces along the way; where the way's cosine to the line of sight is below `facing`, it faces the camera.
    """
    ray = np.append(quad.mean(axis=0), 1.0) @ np.linalg.inv(rig.left.K).T
    place = ray * depth
    s = way.nearest(place)
    point, axes = way.frame(np.array(s))
    along = axes[:, 0] @ ray / np.linalg.norm(ray)
    normal = axes[:, 0] if abs(along) > facing else np.array([0.0, 0.0, 1.0])
    corners = on_plane(rig.left.K, quad, normal, np.asarray(normal @ place))
    # The middle of the corners in space is what is tracked.
    place = corners.mean(axis=0)
    off = place - point
    state = np.array([s + off @ axes[:, 0], 0.0, off @ axes[:, 1], off @ axes[:, 2], 0.0])
    return Shape((corners - place) @ axes), state


@dataclass(frozen=True, slots=True)
class Looked:
    """One frame's measurement (5,): middle in the left view, log height there, middle in the right; noise (5, 5)."""

    frame: int
    t: float
    z: Array
    R: Array
    quads: dict[str, Array]
    correlation: float
    seen: Seen


@dataclass(slots=True)
class Target:
    """A front that is followed."""

    id: int
    rig: StereoRig
    way: Way
    shape: Shape
    config: StereoConfig
    rng: np.random.Generator
    states: Array  # (P, 5)
    log_weights: Array
    sought: Template
    first: Grey  # cell values of the first sight
    reference: Grey
    t: float
    given: bool  # named by init.yaml
    on_path: bool
    free_drift: float  # m a frame at 5 frames/s: drift where there is no path
    oriented: bool = False
    free: bool = False  # six degrees of freedom; else along the way
    last_seen: float = 0.0
    pieces: Pieces = field(default_factory=Pieces)
    looks: list[Looked] = field(default_factory=list)
    nis: list[float] = field(default_factory=list)  # normalised innovation squared of each look but the first
    causal: list[tuple[int, float, Gaussian, bool]] = field(default_factory=list)
    clouds: dict[int, Array] = field(default_factory=dict)  # by frame: where some of the particles stood (n, 3) m
    ended_by: str = ""

    @property
    def mean(self) -> Array:
        """The expected state (5,)."""
        return particles.moments(self.states, self.log_weights).mean


def corners(target: Target, states: Array) -> Array:
    """The front's corners (..., 4, 3) m in states."""
    return free.corners(target.shape.corners, states) if target.free else target.shape.points(target.way, states)


def expected(target: Target, states: Array) -> Array:
    """What would be measured (..., 5) in states: as in `Looked`."""
    quads = quads_of(target, states)
    centre = states[..., free.MIDDLE] if target.free else middle(target.way, states)
    seen = projected(target.rig.left.K, centre), projected(target.rig.right.K, in_right(target.rig, centre))
    return np.concatenate([seen[0], patches.log_height(quads["left"])[..., None], seen[1]], axis=-1)


def quads_of(target: Target, states: Array) -> dict[str, Array]:
    places = corners(target, states)
    return {
        "left": projected(target.rig.left.K, places),
        "right": projected(target.rig.right.K, in_right(target.rig, places)),
    }


def left_quad(target: Target) -> Array:
    """Where the front is expected in the left view (4, 2) px."""
    return quads_of(target, target.mean)["left"]


def leaving(target: Target, size: tuple[int, int]) -> bool:
    """Whether the front has left one of the pictures."""
    quads = quads_of(target, target.mean)
    return not all(patches.inside(quads[view], size) for view in quads)


def drift(target: Target) -> tuple[float, float]:
    """Deviations (m a frame at 5 frames/s) across the path and up and down."""
    settings = target.config.filter
    if target.on_path:
        return settings.sigma_lateral, settings.sigma_vertical
    most = max(target.free_drift, settings.free_share * 0.2 * abs(float(target.mean[V])))
    return most, most / 2
