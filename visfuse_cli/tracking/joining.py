"""Two stretches of one vehicle: which earlier track a new one goes on from."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from visfuse_cli.maths.angles import wrap
from visfuse_cli.records import Array
from visfuse_cli.tracking.dynamics import Dynamics, Step
from visfuse_cli.tracking.targets import Sample, Track, velocity_at_start

CLOSE_M = 2.0  # between the places that both have for one moment
DRIFT = 0.2  # m a metre driven unseen: drivers brake and accelerate
AT_ONCE_S, NEXT = 0.2, 0.35  # s, and of its length: what begins so soon and so near is the same
ASIDE_M, TURNED = 1.5, 0.7  # m off the course and rad turned, while unseen
PART = 0.4  # of both lengths: a part of a vehicle that was followed as one lies that far off
SAME = 0.5  # share of the common frames in which one stands in the place of the other
BELIEVED = 0.7  # share of the outline seen, on average, that makes an earlier stretch worth keeping
WAIT_S = 3.0, 6.0  # s unseen, of what moves and of what stands in a queue
SLOW, STARTS = 2.0, 1.5  # m/s below which it stands, and m/s^2 that it starts with
ALIKE = 0.25  # of the logarithm of its length


def part_before(
    old: Track, dynamics: Dynamics, samples: list[Sample], pose: Array, size: Array
) -> tuple[list[Sample], Array] | None:
    """The part of an earlier track before a new one's samples with poses (n, 3): empty when the earlier one followed
    the same vehicle wrongly, None when it followed another."""
    place = places(old.steps, dynamics)
    kept = [sample for sample in old.samples if sample.frame < samples[0].frame]
    if len(kept) < len(old.samples):
        fits, one = _while_both(old, place, samples, pose, size)
    else:
        planar, _ = dynamics.planar(old.steps[-1].posterior.mean)
        velocity = velocity_at_start(samples, pose)
        fits = one = _drives_on(old, planar, place[-1, 2], samples[0].t, pose[0], size, velocity)
    if not one:
        return None
    return (kept, place[: len(kept)]) if fits and _good(kept) else ([], np.zeros((0, 3)))


def goes_on(old: Track, new: Track, dynamics: Dynamics) -> bool:
    """Whether a track that has ended was in the place of a younger one when that began, having been seen well before:
    it then lost its vehicle to it."""
    k = bisect_left(old.samples, new.samples[0].frame, key=lambda sample: sample.frame)
    if not 0 < k < len(old.samples):
        return False
    along, across, turned = _off(places(old.steps[k : k + 1], dynamics), places(new.steps[:1], dynamics))
    near = (along < PART * (old.size[0] + new.size[0])) & (across < ASIDE_M) & (turned < TURNED)
    return bool(near[0] and _alike(old.size, new.size) and _good(old.samples[:k]))


def places(steps: Sequence[Step], dynamics: Dynamics) -> Array:
    """Where (n, 3) a target is believed to be, m and rad, after each of its steps."""
    was = np.stack([step.posterior.mean for step in steps])
    return np.column_stack([was[:, :2], dynamics.heading(was)])


def _off(place: Array, pose: Array) -> tuple[Array, Array, Array]:
    """How far off (n,) places (n, 3) are from poses (n, 3): m along these and across, and rad turned."""
    apart = place[:, :2] - pose[:, :2]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    along, across = apart[:, 0] * c + apart[:, 1] * s, c * apart[:, 1] - s * apart[:, 0]
    return np.abs(along), np.abs(across), np.abs(wrap(place[:, 2] - pose[:, 2]))


def _while_both(old: Track, place: Array, samples: list[Sample], pose: Array, size: Array) -> tuple[bool, bool]:
    """Whether an earlier track at places (k, 3) may be gone on from in a new one that it has frames in common with, and
    whether the two followed one vehicle."""
    index = {sample.frame: k for k, sample in enumerate(samples)}
    common = [(k, index[s.frame]) for k, s in enumerate(old.samples) if s.frame in index]
    mine, its = np.array(common).T
    along, across, turned = _off(place[mine], pose[its])
    same = (along < max(CLOSE_M, PART * (size[0] + old.size[0]))) & (across < ASIDE_M) & (turned < TURNED)
    # whatever the earlier one did in the end, or was too late to do
    fits = old.samples[0].frame < samples[0].frame and float(np.hypot(along[0], across[0])) < CLOSE_M
    if not fits and lasting(old, samples[0].frame, len(samples)):
        fits = bool(same[0]) and _alike(size, old.size)
        return fits, fits
    return fits, bool(fits or np.mean(same) >= SAME)


def _drives_on(old: Track, planar: Array, heading: float, t: float, pose: Array, size: Array, velocity: Array) -> bool:
    """Whether what was last seen with a planar state (4,) and a heading may stand at a pose (3,) at a later t (s)
    and go on with a velocity (2,)."""
    gap = t - old.samples[-1].t
    speed = max(float(np.hypot(*planar[2:])), 1e-6)
    slow = speed < SLOW  # what hardly moves goes where it faces
    way = np.array([np.cos(heading), np.sin(heading)]) if slow else planar[2:] / speed
    offset = pose[:2] - planar[:2] - gap * planar[2:]
    on, off = float(offset @ way), float(way[0] * offset[1] - way[1] * offset[0])
    turn = abs(wrap(pose[2] - np.arctan2(way[1], way[0])))
    reach = CLOSE_M + DRIFT * gap * speed
    onward = slow or float(velocity @ way) > -SLOW  # what comes the other way is another
    at_once = onward and gap < AT_ONCE_S and float(np.hypot(*offset)) < NEXT * size[0]  # nothing else can be there
    near = -reach < on < reach + slow * STARTS * gap**2 / 2 and abs(off) < ASIDE_M and (turn < TURNED or at_once)
    return bool(near and (gap < WAIT_S[0] or (slow and _alike(size, old.size) and gap < WAIT_S[1])))


def lasting(old: Track, begin: int, frames: int) -> bool:
    """Whether a track was seen so well before a frame, and for more `frames`, that it is not to be forgotten."""
    kept = [sample for sample in old.samples if sample.frame < begin]
    return len(kept) > frames and _good(kept)


def _good(samples: list[Sample]) -> bool:
    believed = [sample.border for sample in samples if sample.measured]
    return len(believed) > 0 and float(np.nanmean(believed)) >= BELIEVED


def _alike(size: Array, other: Array) -> bool:
    return bool(abs(np.log(size[0] / other[0])) < ALIKE)
