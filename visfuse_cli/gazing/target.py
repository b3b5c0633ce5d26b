"""One target on the ground before a pan-tilt head: predicted there, found again in the picture, measured, updated."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from visfuse_cli.gazing.find import View
from visfuse_cli.gazing.head import Head
from visfuse_cli.gazing.models import Courses, combined
from visfuse_cli.maths import course, imm
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.imm import Bank, Step
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, Gaussian
from visfuse_cli.vision import patches
from visfuse_cli.vision.patches import Template

YOUNG = 6  # measurements from which the first place and velocity are estimated
GATE = 1 - 1e-6
TRUST = 4.0  # times an alignment's own covariance
STRETCH = 0.05  # by which a target's picture may be off the size that its distance gives it
START_DOUBT = 9.0  # times the covariance of the first place and velocity: the same frames are filtered again


@dataclass(frozen=True, slots=True)
class Look:
    """One frame: when, where the head looked, and what was seen there: z (4,) m and m/s with R (4, 4), or nothing."""

    frame: int
    t: float
    gaze: Array
    box: Array
    z: Array | None
    R: Array


@dataclass(slots=True)
class Target:
    """A target that is followed; `size` (2,) m of what is seen of it; a step of the bank for each look, once begun."""

    id: int
    head: Head
    config: ImmConfig
    models: Courses
    size: Array
    place: Array  # (2,) m, while the bank has not begun
    sought: Template
    given: bool
    last_seen: float
    looks: list[Look] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    nis: list[float] = field(default_factory=list)
    ahead: list[Gaussian | None] = field(default_factory=list)  # the belief a latency later, look by look
    ended_by: str = ""

    @property
    def height(self) -> float:
        """m over the ground of the point that is tracked: the middle of the box, or its foot."""
        return self.config.target.height or 0.0

    def anchor(self, quad: Array) -> Array:
        """The tracked point (2,) px of a quad (4, 2): its middle where its height is known, else its lower edge's."""
        return quad.mean(axis=0) if self.config.target.height is not None else quad[2:].mean(axis=0)

    def quad_at(self, place: Array, gaze: Array) -> Array:
        """The quad (4, 2) px that is expected at a place (2,) m."""
        at = self.head.pixels(np.append(place, self.height), gaze)
        wide, high = self.size / self.head.depth(place, self.height) * np.diag(self.head.lens.K)[:2]
        quad = np.array([[-wide, -high], [wide, -high], [wide, high], [-wide, high]]) / 2
        return np.asarray(quad + at - self.anchor(quad))


def start(
    identity: int, head: Head, config: ImmConfig, models: Courses, view: View, quad: Array, given: bool
) -> Target | None:
    """Begin with a target in a quad (4, 2) px of a view; None where it is not on the ground."""
    sought = patches.holding(view.levels, quad)
    target = Target(identity, head, config, models, np.ones(2), np.zeros(2), sought, given, view.t)
    at = target.anchor(quad)
    place = head.ground(at, view.gaze, target.height)
    if not np.isfinite(place).all():
        return None
    target.place = place
    target.size = np.array(patches.side(quad)) * head.depth(place, target.height) / np.diag(head.lens.K)[:2]
    measured = _measured(target, at, np.zeros((2, 2)), view.gaze, None)
    target.looks.append(Look(view.frame, view.t, view.gaze, _box(quad), *measured))
    return target


def follow(target: Target, view: View) -> None:
    """One frame further: predict, look, update."""
    dt = view.t - target.looks[-1].t
    step = target.models.predict(target.steps[-1].filtered, dt) if target.steps else None
    place = combined(step.filtered).mean[:2] if step is not None else target.place
    quad = target.quad_at(place, view.gaze)
    found = patches.follow(view.levels, quad, target.sought, STRETCH, target.config.measure.good)
    z, R = None, np.zeros((4, 4))
    if found is not None:
        seen = found.quad(quad)
        z, R = _measured(target, target.anchor(seen), TRUST * found.cov[:2, :2], view.gaze, dt)
        quad = seen if z is not None else quad
    if step is not None:
        updated = _updated(step, z, R) if z is not None else None
        if updated is None:
            z = None
        else:
            step = updated[0]
            target.nis.append(updated[1])
        target.steps.append(step)
        target.ahead.append(_later(target))
    target.looks.append(Look(view.frame, view.t, view.gaze, _box(quad), z, R))
    if z is not None and found is not None:
        target.place, target.last_seen = z[:2], view.t
        if found.correlation < target.config.measure.fresh:
            target.sought = patches.holding(view.levels, quad)
    if not target.steps and sum(look.z is not None for look in target.looks) >= YOUNG:
        _begin(target)


def _measured(target: Target, at: Array, cov: Array, gaze: Array, dt: float | None) -> tuple[Array | None, Array]:
    """z (4,) of place and velocity on the ground, and R (4, 4), from the tracked point (2,) px.

    The velocity is that of the picture since the look before, less the head's own turning. Bradshaw 1997, sec. 4.1.
    """
    measure = target.config.measure
    place = target.head.ground(at, gaze, target.height)
    if not np.isfinite(place).all():
        return None, np.zeros((4, 4))
    J = target.head.jacobian(at, gaze, target.height)
    R = np.zeros((4, 4))
    R[:2, :2] = J @ (cov + measure.place_sigma**2 * np.eye(2)) @ J.T
    before = target.looks[-1] if target.looks else None
    if before is None or before.z is None or not dt:
        R[2:, 2:] = 1e6 * np.eye(2)
        return np.append(place, [0.0, 0.0]), R
    still = target.head.pixels(np.append(before.z[:2], target.height), gaze)  # had only the head turned
    R[2:, 2:] = (measure.flow_sigma / dt) ** 2 * J @ J.T
    return np.append(place, J @ (at - still) / dt), R


def _begin(target: Target) -> None:
    """Begin the bank at the first look, from a line through all looks so far, and filter these."""
    seen = [look for look in target.looks if look.z is not None]
    t = np.array([look.t for look in seen]) - target.looks[0].t
    places = np.array([look.z[:2] for look in seen if look.z is not None])
    A = np.column_stack([np.ones_like(t), t])
    line = np.linalg.lstsq(A, places, rcond=None)[0]
    share = np.linalg.inv(A.T @ A)
    noise = START_DOUBT * np.mean([look.R[:2, :2] for look in seen], axis=0)
    velocity = Gaussian(line[1], share[1, 1] * noise)
    bank = target.models.start(Gaussian(line[0], share[0, 0] * noise), velocity)
    ways = np.broadcast_to(np.eye(6), bank.beliefs.cov.shape)
    step = Step(bank.beliefs, ways, 0 * ways, bank.beliefs, bank.log_mu, bank)
    for k, look in enumerate(target.looks):
        if k:
            step = target.models.predict(step.filtered, look.t - target.looks[k - 1].t)
        updated = _updated(step, look.z, look.R) if look.z is not None else None
        step = updated[0] if updated is not None else step
        target.steps.append(step)
        target.ahead.append(_later(target))


def _updated(step: Step, z: Array, R: Array) -> tuple[Step, float] | None:
    """The step after a measurement, and how far off that was; None outside the gate of every motion."""
    h, H = course.observe(step.predicted.mean)
    updated, innovation = imm.update(step, z - h, H, R)
    if innovation.nis.min() > gate_size(len(z), GATE):
        return None
    return updated, float(np.exp(updated.filtered.log_mu) @ innovation.nis)


def _later(target: Target) -> Gaussian | None:
    if target.config.latency <= 0:
        return None
    return combined(target.models.predict(target.steps[-1].filtered, target.config.latency).filtered)


def belief(bank: Bank) -> Gaussian:
    """Place and velocity (4,) on the ground."""
    one = combined(bank)
    mean, J = course.observe(one.mean)
    return Gaussian(mean, J @ one.cov @ J.T)


def _box(quad: Array) -> Array:
    low, top = quad.min(axis=0), quad.max(axis=0)
    return np.concatenate([low, top - low])
