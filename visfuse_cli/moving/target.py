"""One target before a moving stereo head: predicted in the world, found again in both views, measured, updated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from visfuse_cli.maths import imm
from visfuse_cli.maths.imm import Bank, Step
from visfuse_cli.maths.kept import Banks, Rows
from visfuse_cli.maths.planes import in_right, projected, triangulated
from visfuse_cli.moving.head import Head, Pair
from visfuse_cli.moving.measure import across, measurement, updated
from visfuse_cli.moving.models import Models, P, V
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, Gaussian, StereoRig
from visfuse_cli.vision import patches
from visfuse_cli.vision.boxes import box_of
from visfuse_cli.vision.looks import ALIKE, COASTED_S, HIDDEN, KEEP_LOOKS, SETTLED_S, looks, unlike
from visfuse_cli.vision.patches import Alignment, Template

STRETCH = 0.2  # by which a target's picture may be off the size that its distance gives it
TRUST = 4.0  # times an alignment's own covariance
NEAREST = 0.2  # m before the camera
REACH = 3.0  # px of disparity around the expected one, at least
FASTER, FAST, SLACK_M = 2.0, 1.5, 0.5  # times its pace, m/s, m: how far a lost target may have come

VIEWS = ("left", "right")
# A frame: number, time s, how far off the measurement was, boxes px, place m a latency later; NaN is none, or unseen.
SEEN = [("frame", int), ("t", float), ("nis", float), *((view, float, 4) for view in VIEWS), ("ahead", float, 3)]


@dataclass(slots=True, eq=False)
class Target:
    """A target that is followed; `size` (2,) m of its visible surface, `colours` (bands, 3) what it looks like.

    `earlier` is what was seen of it before it was lost or away.
    """

    id: int
    rig: StereoRig
    config: ImmConfig
    models: Models
    bank: Bank
    size: Array
    sought: Template
    colours: Array
    head: Head
    given: bool
    last_seen: float
    banks: Banks  # frame by frame
    seen: Rows = field(default_factory=lambda: Rows(SEEN))
    box: Array | None = None  # the latest left one [x, y, w, h] px; none out of sight
    measured: bool = True  # whether it was seen there
    ended_by: str = ""
    away: float = 0.0  # m that the camera moved since the target began
    seen_since: float = -np.inf  # s: since when it is seen without a break
    alone_at: float = 0.0  # s: when last no other target was where this one is
    earlier: Target | None = None

    @property
    def belief(self) -> Gaussian:
        """The common belief (12,)."""
        return imm.combined(self.bank)


@dataclass(frozen=True, slots=True)
class Expected:
    """Where a target is thought to be: the step that led there, its quads (4, 2) by view, and its depth m."""

    step: Step
    quads: dict[str, Array]
    depth: float
    doubt: float  # of the depth, as a share of it

    @property
    def box(self) -> Array | None:
        """[x, y, w, h] px in the left view; none out of sight."""
        return box_of(self.quads["left"]) if self.quads else None


def start(
    identity: int,
    rig: StereoRig,
    config: ImmConfig,
    models: Models,
    pair: Pair,
    left: Array,
    right: Array,
    velocity: Gaussian,
    given: bool,
) -> Target | None:
    """Begin with a target in left and right quads (4, 2) px; None where it lies behind the camera."""
    found = across(rig, pair, left, right, 2 * REACH)
    if found is not None:
        right = found[0]
    place = triangulated(rig, left.mean(axis=0), right.mean(axis=0))
    if not np.isfinite(place).all() or place[2] <= NEAREST:
        return None
    focal, head = np.diag(rig.left.K)[:2], pair.head
    size = np.array(patches.side(left)) * place[2] / focal
    rays = place / place[2]
    sigma = place[2] ** 2 / (focal[0] * rig.baseline) * 0.7
    cov = sigma**2 * np.outer(rays, rays) + (0.005 * place[2]) ** 2 * np.eye(3)
    bank = models.start(Gaussian(head.outside(place), head.R @ cov @ head.R.T), velocity)
    sought, seen = patches.holding(pair.levels, left), looks(pair.pictures["left"], left)
    own = Target(identity, rig, config, models, bank, size, sought, seen, head, given, head.t, models.kept(bank))
    own.alone_at = head.t
    _note(own, pair, {"left": left, "right": right}, 0.0)
    return own


def _note(target: Target, pair: Pair, quads: Mapping[str, Array], nis: float) -> None:
    """Keep what a frame told: the quads (4, 2) px by view, how far off the measurement was, and the place ahead."""
    boxes = {view: box_of(quad) for view, quad in quads.items()}
    target.box, target.measured = boxes.get("left"), bool(np.isfinite(nis))
    latency = target.config.latency
    later = imm.combined(target.models.predict(target.bank, latency).filtered).mean[P] if latency > 0 else np.nan
    target.seen.append(pair.frame, pair.t, nis, *(boxes.get(view, np.nan) for view in VIEWS), later)


def expect(target: Target, head: Head) -> Expected:
    """Where the target is thought to be as the head is there; its quads are empty behind the camera."""
    step = target.models.predict(target.bank, head.t - target.head.t)
    belief = imm.combined(step.filtered)
    place = head.inside(belief.mean[P])
    sigma = float(np.sqrt(head.R[:, 2] @ belief.cov[P, P] @ head.R[:, 2]))
    return Expected(step, quads_at(target, place), float(place[2]), sigma / max(float(place[2]), NEAREST))


def quads_at(target: Target, place: Array) -> dict[str, Array]:
    """The quads (4, 2) px by view of the target at a place (3,) m of the camera's frame; none behind it."""
    if place[2] < NEAREST:
        return {}
    across, down = np.array([target.size[0] / 2, 0, 0]), np.array([0, target.size[1] / 2, 0])
    corners = place + np.stack([-across - down, across - down, across + down, -across + down])
    right = projected(target.rig.right.K, in_right(target.rig, corners))
    return {"left": projected(target.rig.left.K, corners), "right": right}


def follow(target: Target, pair: Pair, expected: Expected, hidden: float) -> None:
    """One frame further: look where it is expected, unless too large a share of it is hidden by others, and update."""
    before, head, step = target.head, pair.head, expected.step
    target.away += float(np.linalg.norm(head.T - before.T))
    target.bank, target.head = step.filtered, head
    quads = expected.quads
    found = _look(target, pair, expected) if quads and hidden < HIDDEN else None
    nis = np.nan
    if found is not None:
        left, right, R, alignment = found
        R[0, 0] += (hidden * patches.side(left)[0]) ** 2  # what is left to be seen lies to one side
        z, R = measurement(target.config.measure, left, right, R, pair.flow)
        after = updated(target.rig, step, z, R, head, before)
        if after is not None:
            step, nis = after
            target.bank = step.filtered
            quads = {"left": left, "right": right}
            target.seen_since = target.seen_since if target.measured else head.t
            target.last_seen = head.t
            _refresh(target, pair, left, alignment)
    target.banks.append(target.bank)
    _note(target, pair, quads, nis)


def alike(target: Target, pair: Pair, quad: Array) -> bool:
    """Whether what a left quad (4, 2) shows looks as the target did."""
    return unlike(target.colours, looks(pair.pictures["left"], quad)) < ALIKE


def found_again(target: Target, pair: Pair, middle: Array, depth: float) -> Array | None:
    """The left quad (4, 2) of a target that was lost, around a pixel (2,) at a depth (m); None where it is not it.

    It does not look like it, or cannot have come there.
    """
    focal = np.diag(target.rig.left.K)[:2]
    place = pair.head.outside(depth * (np.linalg.inv(target.rig.left.K) @ np.append(middle, 1.0)))
    last = int(np.flatnonzero(np.isfinite(target.seen[:]["nis"]))[-1])
    then = imm.combined(target.banks[last]).mean
    pace = max(FASTER * float(np.linalg.norm(then[V])), FAST)
    if np.linalg.norm(place - then[P]) > 0.1 * depth + SLACK_M + pace * (pair.t - target.last_seen):
        return None
    half = target.size * focal / depth / 2
    quad = middle + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    moved = patches.searched(pair.levels[0], quad, target.sought, patches.SEARCH, target.config.measure.good)
    if moved is None or not patches.inside(moved, pair.size, 0) or not alike(target, pair, moved):
        return None
    return moved


def _look(target: Target, pair: Pair, expected: Expected) -> tuple[Array, Array, Array, Alignment] | None:
    """Left and right quads (4, 2) where the target is seen, the noise (4, 4) of both middles, and the fit; or None."""
    left = expected.quads["left"]
    found = patches.follow(pair.levels, left, target.sought, STRETCH, target.config.measure.good)
    if found is None:
        return None
    moved = found.quad(left)
    if pair.head.t - target.last_seen > COASTED_S and not alike(target, pair, moved):
        return None
    right = expected.quads["right"] + (moved - expected.quads["left"])
    disparity = abs(float(np.mean(moved[:, 0] - right[:, 0])))
    opposite = across(target.rig, pair, moved, right, REACH + 3 * min(expected.doubt, 0.1) * disparity)
    if opposite is None:
        return None
    R = np.zeros((4, 4))
    R[:2, :2] = TRUST * found.cov[:2, :2]
    R[2:, 2:] = np.diag(opposite[1])
    return moved, opposite[0], R, found


def _refresh(target: Target, pair: Pair, left: Array, found: Alignment) -> None:
    """Take the template anew where the target has turned, and let its size and looks follow slowly."""
    place = pair.head.inside(target.belief.mean[P])
    size = np.array(patches.side(left)) * place[2] / np.diag(target.rig.left.K)[:2]
    target.size = target.size + 0.1 * (np.clip(size, 0.8 * target.size, 1.25 * target.size) - target.size)
    target.colours = KEEP_LOOKS * target.colours + (1 - KEEP_LOOKS) * looks(pair.pictures["left"], left)
    if found.correlation < target.config.measure.fresh and pair.head.t - target.seen_since > SETTLED_S:
        target.sought = patches.holding(pair.levels, left)
