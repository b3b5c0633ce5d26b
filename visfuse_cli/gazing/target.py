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
from visfuse_cli.maths.motion import line_start
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, Gaussian
from visfuse_cli.vision import patches
from visfuse_cli.vision.boxes import box_of
from visfuse_cli.vision.looks import ALIKE, COASTED_S, HIDDEN, KEEP_LOOKS, SETTLED_S, looks, unlike
from visfuse_cli.vision.patches import Alignment, Template

FASTER, FAST, SLACK_M = 2.0, 1.5, 0.5  # times its pace, m/s, m: how far a lost target may have come
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


@dataclass(frozen=True, slots=True)
class Expected:
    """Where a target is thought to be: the step that led there (if the bank has begun), quad (4, 2) px, depth m, s."""

    step: Step | None
    quad: Array
    depth: float
    dt: float

    @property
    def box(self) -> Array | None:
        """[x, y, w, h] px; none out of sight."""
        return box_of(self.quad) if np.isfinite(self.quad).all() else None


@dataclass(slots=True, eq=False)
class Target:
    """A target that is followed; `size` (2,) m of what is seen of it; a step of the bank for each look, once begun."""

    id: int
    head: Head
    config: ImmConfig
    models: Courses
    size: Array
    place: Array  # (2,) m, while the bank has not begun
    sought: Template
    colours: Array  # (bands, 3): what it looks like
    given: bool
    last_seen: float
    seen_since: float = -np.inf  # s: since when it is seen without a break
    looks: list[Look] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    nis: list[float] = field(default_factory=list)
    ahead: list[Gaussian | None] = field(default_factory=list)  # the belief a latency later, look by look
    ended_by: str = ""
    earlier: Target | None = None  # what was seen of it before it was lost or away

    @property
    def box(self) -> Array | None:
        """The latest box [x, y, w, h] px; none out of sight."""
        box = self.looks[-1].box
        return box if np.isfinite(box).all() else None

    @property
    def measured(self) -> bool:
        """Whether it was seen there."""
        return self.looks[-1].z is not None

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
    sought, colours = patches.holding(view.levels, quad), looks(view.picture, quad)
    target = Target(identity, head, config, models, np.ones(2), np.zeros(2), sought, colours, given, view.t)
    at = target.anchor(quad)
    place = head.ground(at, view.gaze, target.height)
    if not np.isfinite(place).all():
        return None
    target.place = place
    target.size = np.array(patches.side(quad)) * head.depth(place, target.height) / np.diag(head.lens.K)[:2]
    measured = _measured(target, at, np.zeros((2, 2)), view.gaze, None)
    target.looks.append(Look(view.frame, view.t, view.gaze, box_of(quad), *measured))
    return target


def expect(target: Target, view: View) -> Expected:
    """Where the target is thought to be in a view."""
    dt = view.t - target.looks[-1].t
    step = target.models.predict(target.steps[-1].filtered, dt) if target.steps else None
    place = combined(step.filtered).mean[:2] if step is not None else target.place
    return Expected(step, target.quad_at(place, view.gaze), target.head.depth(place, target.height), dt)


def follow(target: Target, view: View, expected: Expected, hidden: float) -> None:
    """One frame further: look where it is expected, unless too large a share of it is hidden by others, and update."""
    step, quad, dt = expected.step, expected.quad, expected.dt
    found = _seen(target, view, quad) if hidden < HIDDEN else None
    z, R = None, np.zeros((4, 4))
    if found is not None:
        seen = found.quad(quad)
        aside = np.diag([(hidden * patches.side(seen)[0]) ** 2, 0.0])  # what is left to be seen lies to one side
        z, R = _measured(target, target.anchor(seen), TRUST * found.cov[:2, :2] + aside, view.gaze, dt)
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
    target.looks.append(Look(view.frame, view.t, view.gaze, box_of(quad), z, R))
    if z is not None and found is not None:
        target.seen_since = target.seen_since if target.looks[-2].z is not None else view.t
        target.place, target.last_seen = z[:2], view.t
        target.colours = KEEP_LOOKS * target.colours + (1 - KEEP_LOOKS) * looks(view.picture, quad)
        if found.correlation < target.config.measure.fresh and view.t - target.seen_since > SETTLED_S:
            target.sought = patches.holding(view.levels, quad)
    if not target.steps and sum(look.z is not None for look in target.looks) >= YOUNG:
        _begin(target)


def _seen(target: Target, view: View, quad: Array) -> Alignment | None:
    """The target near a quad (4, 2); after some time unseen, only what looks as it did."""
    found = patches.follow(view.levels, quad, target.sought, STRETCH, target.config.measure.good)
    if found is None or view.t - target.last_seen <= COASTED_S:
        return found
    return found if unlike(target.colours, looks(view.picture, found.quad(quad))) < ALIKE else None


def found_again(target: Target, view: View, quad: Array) -> Array | None:
    """The quad (4, 2) of a target that was lost, in what moves in `quad`; None where it is not it, or cannot be."""
    place = target.head.ground(target.anchor(quad), view.gaze, target.height)
    if not np.isfinite(place).all():
        return None
    pace = (
        max(FASTER * float(np.linalg.norm(belief(target.steps[-1].filtered).mean[2:])), FAST) if target.steps else FAST
    )
    away = target.head.depth(place, target.height)
    if np.linalg.norm(place - target.place) > 0.1 * away + SLACK_M + pace * (view.t - target.last_seen):
        return None
    moved = patches.searched(
        view.levels[0], target.quad_at(place, view.gaze), target.sought, patches.SEARCH, target.config.measure.good
    )
    if moved is None or unlike(target.colours, looks(view.picture, moved)) >= ALIKE:
        return None
    return moved


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
    noise = START_DOUBT * np.mean([look.R[:2, :2] for look in seen], axis=0)
    bank = target.models.start(*line_start(t, places, noise))
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
