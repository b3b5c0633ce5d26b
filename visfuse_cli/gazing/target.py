"""One target on the ground before a pan-tilt head: predicted there, found again in the picture, measured, updated."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from visfuse_cli.gazing.find import View, may_be_wider
from visfuse_cli.gazing.head import Head
from visfuse_cli.gazing.models import Courses, combined
from visfuse_cli.maths import course, imm
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.imm import Bank, Step
from visfuse_cli.maths.kept import Banks, Rows
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


# A frame: number, time s, box px, and what was measured, m and m/s; NaN is nothing, or out of sight.
SEEN = [("frame", int), ("t", float), ("box", float, 4), ("z", float, 4)]
# What was then believed: how far off the measurement was, and the place m a latency later; NaN is none.
BELIEVED = [("nis", float), ("ahead", float, 2)]


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
    """A target that is followed; `size` (2,) m of what is seen of it; its banks by frame, once there are some."""

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
    wider: float  # times its width, at most, that it may be where it was begun in part
    seen_since: float = -np.inf  # s: since when it is seen without a break
    seen: Rows = field(default_factory=lambda: Rows(SEEN))
    noises: list[Array] = field(default_factory=list)  # R (4, 4) of what was measured before there was a bank
    bank: Bank | None = None
    banks: Banks | None = None
    believed: Rows = field(default_factory=lambda: Rows(BELIEVED))
    ended_by: str = ""
    earlier: Target | None = None  # what was seen of it before it was lost or away

    @property
    def box(self) -> Array | None:
        """The latest box [x, y, w, h] px; none out of sight."""
        box: Array = self.seen[-1]["box"]
        return box if np.isfinite(box).all() else None

    @property
    def measured(self) -> bool:
        """Whether it was seen there."""
        return bool(np.isfinite(self.seen[-1]["z"][0]))

    def box_at(self, frame: int) -> Array | None:
        """The box [x, y, w, h] px in a frame of late; none before it was begun, or out of sight."""
        rows = (self.seen[k] for k in range(len(self.seen) - 1, -1, -1))
        row = next((row for row in rows if row["frame"] <= frame), None)
        return row["box"] if row is not None and np.isfinite(row["box"]).all() else None

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
    wider = may_be_wider(quad, view.grey.shape[1])
    target = Target(identity, head, config, models, np.ones(2), np.zeros(2), sought, colours, given, view.t, wider)
    at = target.anchor(quad)
    place = head.ground(at, view.gaze, target.height)
    if not np.isfinite(place).all():
        return None
    target.place = place
    target.size = np.array(patches.side(quad)) * head.depth(place, target.height) / np.diag(head.lens.K)[:2]
    _note(target, view, quad, *_measured(target, at, np.zeros((2, 2)), view.gaze, None))
    return target


def _note(target: Target, view: View, quad: Array, z: Array | None, R: Array) -> None:
    """Keep what a frame told: the quad (4, 2) px, and what was measured, if anything."""
    target.seen.append(view.frame, view.t, box_of(quad), np.nan if z is None else z)
    if target.banks is None:
        target.noises.append(R)


def expect(target: Target, view: View) -> Expected:
    """Where the target is thought to be in a view."""
    dt = view.t - float(target.seen[-1]["t"])
    step = target.models.predict(target.bank, dt) if target.bank is not None else None
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
        z = z if updated is not None else None
        _believe(target, *(updated or (step, np.nan)))
    fresh = not target.measured
    _note(target, view, quad, z, R)
    if z is not None and found is not None:
        target.seen_since = view.t if fresh else target.seen_since
        target.place, target.last_seen = z[:2], view.t
        target.colours = KEEP_LOOKS * target.colours + (1 - KEEP_LOOKS) * looks(view.picture, quad)
        if found.correlation < target.config.measure.fresh and view.t - target.seen_since > SETTLED_S:
            target.sought = patches.holding(view.levels, quad)
    if target.banks is None and np.count_nonzero(np.isfinite(target.seen[:]["z"][:, 0])) >= YOUNG:
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
    pace = FAST if target.bank is None else max(FASTER * float(np.linalg.norm(belief(target.bank).mean[2:])), FAST)
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
    before = target.seen[-1]["z"] if len(target.seen) else np.full(4, np.nan)
    if not dt or np.isnan(before[0]):
        R[2:, 2:] = 1e6 * np.eye(2)
        return np.append(place, [0.0, 0.0]), R
    still = target.head.pixels(np.append(before[:2], target.height), gaze)  # had only the head turned
    R[2:, 2:] = (measure.flow_sigma / dt) ** 2 * J @ J.T
    return np.append(place, J @ (at - still) / dt), R


def _begin(target: Target) -> None:
    """Begin the bank at the first frame, from a line through all that was measured so far, and filter these."""
    rows = target.seen[:]
    measured = np.isfinite(rows["z"][:, 0])
    noise = START_DOUBT * np.mean(np.stack(target.noises)[measured][:, :2, :2], axis=0)
    bank = target.models.start(*line_start(rows["t"][measured] - rows["t"][0], rows["z"][measured, :2], noise))
    ways = np.broadcast_to(np.eye(6), bank.beliefs.cov.shape)
    step = Step(bank.beliefs, ways, 0 * ways, bank.beliefs, bank.log_mu, bank)
    for k, R in enumerate(target.noises):
        if k:
            step = target.models.predict(step.filtered, float(rows["t"][k] - rows["t"][k - 1]))
        updated = _updated(step, rows["z"][k], R) if measured[k] else None
        step = updated[0] if updated is not None else step
        _believe(target, step, np.nan)
    target.noises.clear()


def _believe(target: Target, step: Step, nis: float) -> None:
    """Keep what is believed after a frame, how far off its measurement was, and the place a latency later."""
    target.bank = step.filtered
    if target.banks is None:
        target.banks = target.models.kept(target.bank)
    else:
        target.banks.append(target.bank)
    latency = target.config.latency
    later = combined(target.models.predict(target.bank, latency).filtered).mean[:2] if latency > 0 else np.nan
    target.believed.append(nis, later)


def _updated(step: Step, z: Array, R: Array) -> tuple[Step, float] | None:
    """The step after a measurement, and how far off that was; None outside the gate of every motion."""
    h, H = course.observe(step.predicted.mean)
    updated, innovation = imm.update(step, z - h, H, R)
    if innovation.nis.min() > gate_size(len(z), GATE):
        return None
    return updated, float(np.exp(updated.filtered.log_mu) @ innovation.nis)


def belief(bank: Bank) -> Gaussian:
    """Place and velocity (4,) on the ground."""
    one = combined(bank)
    mean, J = course.observe(one.mean)
    return Gaussian(mean, J @ one.cov @ J.T)
