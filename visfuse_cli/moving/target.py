"""One target before a moving stereo head: predicted in the world, found again in both views, measured, updated."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from visfuse_cli.maths import imm
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.imm import Bank, Step
from visfuse_cli.maths.planes import in_right, projected, triangulated
from visfuse_cli.moving.models import SIZE, Models, P, V
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, Gaussian, StereoRig
from visfuse_cli.vision import patches
from visfuse_cli.vision.disparity import region_shift
from visfuse_cli.vision.patches import Grey, Template

STEP = 1e-3  # m, m/s: of the numerical Jacobian
GATE = 1 - 1e-7
SEARCH = 0.8  # of its size: how far around the prediction a lost target is looked for
TRUST = 4.0  # times an alignment's own covariance


@dataclass(frozen=True, slots=True)
class Head:
    """Where the left camera is at one instant: x_world = R x_camera + T."""

    t: float
    R: Array
    T: Array

    def inside(self, points: Array) -> Array:
        """World points (..., 3) m in the camera's frame."""
        return np.asarray((points - self.T) @ self.R)

    def outside(self, points: Array) -> Array:
        """Points (..., 3) m of the camera's frame in the world."""
        return np.asarray(points @ self.R.T + self.T)


@dataclass(frozen=True, slots=True)
class Seen:
    """One frame: its number, time, head, boxes by view, whether it was measured, and the bank before and after."""

    frame: int
    t: float
    head: Head
    boxes: dict[str, Array]
    measured: bool
    step: Step
    nis: float
    ahead: Gaussian | None  # the common belief a latency later


@dataclass(slots=True)
class Target:
    """A target that is followed; `size` (2,) m of its visible surface."""

    id: int
    rig: StereoRig
    config: ImmConfig
    models: Models
    bank: Bank
    size: Array
    sought: Template
    head: Head
    given: bool
    last_seen: float
    history: list[Seen] = field(default_factory=list)
    ended_by: str = ""
    away: float = 0.0  # m that the camera moved since the target began

    @property
    def belief(self) -> Gaussian:
        """The common belief (12,)."""
        return imm.combined(self.bank)


def start(
    identity: int,
    rig: StereoRig,
    config: ImmConfig,
    models: Models,
    views: dict[str, list[Grey]],
    left: Array,
    right: Array,
    frame: int,
    head: Head,
    velocity: Array,
    given: bool,
) -> Target | None:
    """Begin with a target in left and right quads (4, 2) px; None where it lies behind the camera."""
    shifted = region_shift(views, left, (right - left).mean(axis=0), config.measure.good)
    if shifted is not None:
        right = left + shifted[0]
    place = triangulated(rig, left.mean(axis=0), right.mean(axis=0))
    if not np.isfinite(place).all() or place[2] <= 0.1:
        return None
    focal = np.diag(rig.left.K)[:2]
    size = np.array(patches.side(left)) * place[2] / focal
    rays = place / place[2]
    sigma = place[2] ** 2 / (focal[0] * rig.baseline) * 0.7
    cov = sigma**2 * np.outer(rays, rays) + (0.005 * place[2]) ** 2 * np.eye(3)
    bank = models.start(Gaussian(head.outside(place), head.R @ cov @ head.R.T), velocity)
    target = Target(
        identity, rig, config, models, bank, size, patches.template(views["left"], left), head, given, head.t
    )
    nothing = np.zeros_like(bank.beliefs.cov)
    first = Step(bank.beliefs, nothing + np.eye(SIZE), nothing, bank.beliefs, bank.log_mu, bank)
    boxes = {"left": _box(left), "right": _box(right)}
    target.history.append(Seen(frame, head.t, head, boxes, True, first, 0.0, None))
    return target


def follow(target: Target, views: dict[str, list[Grey]], flow: Array | None, frame: int, head: Head) -> None:
    """One frame further: predict, look, update. `flow` (H, W, 2) px since the frame before, where it is known."""
    before = target.head
    step = target.models.predict(target.bank, head.t - before.t)
    target.away += float(np.linalg.norm(head.T - before.T))
    target.bank, target.head = step.filtered, head
    quads = _expected_quads(target)
    found = _look(target, views, quads) if quads is not None else None
    nis, measured = 0.0, False
    if found is not None:
        left, right, R = found
        z, R = _measurement(target, left, right, R, flow, head.t - before.t)
        updated = _updated(target, step, z, R, head, before)
        if updated is not None:
            step, nis = updated
            target.bank = step.filtered
            measured, quads = True, {"left": left, "right": right}
            target.last_seen = head.t
            _refresh(target, views, left, head)
    boxes = {} if quads is None else {view: _box(quad) for view, quad in quads.items()}
    later = None
    if target.config.latency > 0:
        later = imm.combined(target.models.predict(target.bank, target.config.latency).filtered)
    target.history.append(Seen(frame, head.t, head, boxes, measured, step, nis, later))


def _expected_quads(target: Target) -> dict[str, Array] | None:
    """Where the target is expected in both views; None behind the camera."""
    place = target.head.inside(target.belief.mean[P])
    if place[2] < 0.2:
        return None
    across, down = np.array([target.size[0] / 2, 0, 0]), np.array([0, target.size[1] / 2, 0])
    corners = place + np.stack([-across - down, across - down, across + down, -across + down])
    right = projected(target.rig.right.K, in_right(target.rig, corners))
    return {"left": projected(target.rig.left.K, corners), "right": right}


def _look(target: Target, views: dict[str, list[Grey]], quads: dict[str, Array]) -> tuple[Array, Array, Array] | None:
    """Left and right quads (4, 2) where the target is seen, and the noise (4, 4) of both middles; or None."""
    size = views["left"][0].shape[1], views["left"][0].shape[0]
    left = quads["left"]
    good = target.config.measure.good
    found = patches.align(views["left"], left, target.sought, 0.2) if patches.inside(left, size, 0) else None
    if found is None or found.correlation < good:
        moved = patches.searched(views["left"][0], left, target.sought, SEARCH, good)
        if moved is None or not patches.inside(moved, size, 0):
            return None
        left = moved
        found = patches.align(views["left"], left, target.sought, 0.2)
        if found is None or found.correlation < good:
            return None
    left = found.quad(left)
    shift = region_shift(views, left, (quads["right"] - quads["left"]).mean(axis=0), good)
    if shift is None:
        return None
    R = np.zeros((4, 4))
    R[:2, :2] = TRUST * found.cov[:2, :2]
    R[2:, 2:] = np.diag(shift[1])
    return left, left + shift[0], R


def _measurement(
    target: Target, left: Array, right: Array, noise: Array, flow: Array | None, dt: float
) -> tuple[Array, Array]:
    """z (5,): flow (2,) px a frame, disparity, middle (2,) px; and its noise (5, 5). Jia 2008, eq. 17."""
    settings = target.config.measure
    u, v = left.mean(axis=0)
    z = np.array([0.0, 0.0, u - right[:, 0].mean(), u, v])
    R = np.zeros((5, 5))
    R[2, 2] = noise[2, 2] + settings.disparity_sigma**2
    R[3:, 3:] = noise[:2, :2] + settings.place_sigma**2 * np.eye(2)
    mean = None if flow is None else _mean_flow(left, flow)
    if mean is None:
        R[:2, :2] = 1e6 * np.eye(2)
    else:
        z[:2] = mean
        R[:2, :2] = settings.flow_sigma**2 * np.eye(2)
    return z, R


def _mean_flow(quad: Array, flow: Array) -> Array | None:
    """The median flow (2,) px inside the inner half of a quad; None where it leaves the picture."""
    middle, half = quad.mean(axis=0), np.array(patches.side(quad)) / 4
    low, top = np.maximum(np.rint(middle - half), 0).astype(int), np.rint(middle + half).astype(int) + 1
    part = flow[low[1] : top[1], low[0] : top[0]].reshape(-1, 2)
    return np.median(part, axis=0) if len(part) else None


def expected(rig: StereoRig, states: Array, head: Head, before: Head) -> Array:
    """What would be measured (..., 5) of common states (..., 12), by geometry alone. Jia 2008, eq. 17.

    The flow is that of a point that was a step of its velocity back, seen from where the camera then was: its turning
    and its way are in it.
    """
    dt = head.t - before.t
    here = head.inside(states[..., P])
    past = before.inside(states[..., P] - states[..., V] * dt)
    left = projected(rig.left.K, here)
    right = projected(rig.right.K, in_right(rig, here))
    flow = left - projected(rig.left.K, past)
    return np.concatenate([flow, left[..., :1] - right[..., :1], left], axis=-1)


def _updated(target: Target, step: Step, z: Array, R: Array, head: Head, before: Head) -> tuple[Step, float] | None:
    """The step after the measurement, and how far that was off; None where no model can believe it."""
    change = STEP * np.eye(6, SIZE)
    tried = step.predicted.mean[:, None] + np.concatenate([np.zeros((1, SIZE)), change, -change])  # (r, 13, 12)
    h = expected(target.rig, tried, head, before)
    if not np.isfinite(h).all():
        return None
    J = np.zeros((len(h), len(z), SIZE))
    J[:, :, :6] = np.swapaxes(h[:, 1:7] - h[:, 7:], 1, 2) / (2 * STEP)
    updated, innovation = imm.update(step, z - h[:, 0], J, R)
    if innovation.nis.min() > gate_size(len(z), GATE):
        return None
    return updated, float(np.exp(updated.filtered.log_mu) @ innovation.nis)


def _refresh(target: Target, views: dict[str, list[Grey]], left: Array, head: Head) -> None:
    """Take the template anew where the target has turned, and let its size follow slowly."""
    place = head.inside(target.belief.mean[P])
    size = np.array(patches.side(left)) * place[2] / np.diag(target.rig.left.K)[:2]
    target.size = target.size + 0.1 * (np.clip(size, 0.8 * target.size, 1.25 * target.size) - target.size)
    found = patches.align(views["left"], left, target.sought, 0.05)
    if found is None or found.correlation < target.config.measure.fresh:
        target.sought = patches.template(views["left"], left)


def _box(quad: Array) -> Array:
    """[x, y, w, h] around a quad (4, 2)."""
    low, top = quad.min(axis=0), quad.max(axis=0)
    return np.concatenate([low, top - low])
