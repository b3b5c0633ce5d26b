"""The speed of a finished track with its 95 % interval, or the reason why it gets none."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import maximum_filter1d

from visfuse_cli.config import Section
from visfuse_cli.maths.speed import KMH, way
from visfuse_cli.records import Array
from visfuse_cli.tracking.conclude import Path
from visfuse_cli.tracking.measure import is_slim

Z95 = 1.959964
STANDS = 0.3  # m/s
TURN_M = 0.25  # m a radian: the middle of a fitted box shifts as the vehicle shows another side
SIZE_DOUBT = 0.05  # of a size: no vehicle is quite a box
GOOD_ENOUGH, LONGER_FOR = 0.01, 1.5  # standard deviation of a speed over itself
DOUBTFUL_ENDS, SHORT_S = ("jumped", "no longer looks like itself"), 1.0  # s: a track that does so sooner is nothing
APART, SOLID, LASTING, EXACT, ODD = 3.0, 1.9, 0.75, 0.5, 0.42  # a logistic fit to traffic, true tracks against false
SHORT_LOOK_S, USUAL_NOISE, SLOW = 2.0, 0.01, 1.5  # s; of a speed; m/s: of what is slower no share of its speed is asked
LIKE_A_PART = 0.5  # what it takes off that a slim thing looks like parts of others, whatever its size
UNSEEN_S = 1.5  # s: a stretch goes over no longer gap
JUMP_S = 0.3  # s a change of speed is looked at
SUDDEN = 2.0  # times as much as it is counts what a vehicle gains: it cannot as fast as it brakes
WANDER_PX, WANDER_S = 0.6, 2.0  # px by which outlines lie off, and s for which they do: noise that frames share
USUAL_MISFIT_PX, AMIDST = 2.2, 10.0  # rms misfit of an outline; what a share of it amidst others adds to its logarithm
LEAST_DOUBT, MOST_DOUBT = 0.33, 2.5  # times as far as usual that outlines lie off


class SpeedSettings(Section):
    """What it takes to be given a speed; a track that fails goes to rejected.csv with the reason."""

    min_frames: int = Field(6, ge=3, le=10000, description="measured frames")
    min_duration_s: float = Field(0.4, gt=0, le=600, description="s: shortest stretch a speed is measured over")
    min_distance_m: float = Field(2.0, gt=0, le=1000, description="m: shortest way a speed is measured over")
    max_sigma: float = Field(0.08, gt=0, le=10, description="standard deviation over speed: above, too uncertain")
    max_acceleration: float = Field(9.0, gt=0, le=100, description="m/s^2: above, the track has jumped")
    min_evidence: float = Field(
        4.0,
        ge=0,
        le=10,
        description="share of its outline that was found, plus 3 times the share that does not lie in the midst of "
        "others, plus 1.9 times the share of its area that is neither shadow nor empty road, plus 0.75 times the "
        "logarithm of the time it was seen over 2 s, less 0.5 times that of its speed's noise over 1 % of it, less "
        "0.42 for each deviation of its size from its class, or 0.5 for what is long and narrower than a metre",
    )
    min_measured: float = Field(0.6, ge=0, le=1, description="share of a track's frames that must be measured")
    max_misfit: float = Field(0.2, gt=0, le=5, description="outline misfit over outline size: above, no such box")
    max_size_z: float = Field(5.5, gt=0, le=100, description="deviations of a size from its class, all three together")
    max_refused: float = Field(
        0.5, gt=0, le=1, description="share of measurements outside the gate: above, inconsistent"
    )
    max_calibration: float = Field(
        0.1, gt=0, le=10, description="trusted zone: deviation of 50 km/h over a second that calibration may cause"
    )
    sigma_t_s: float = Field(0.0005, ge=0, le=1, description="s: noise of one time stamp")


@dataclass(frozen=True, slots=True)
class Verdict:
    """A stretch [first, last] of a path: mean speed and deviation (m/s), way (m), course (rad), reason or ''.

    `noise` (m/s) is the deviation without what all vehicles share, if the box fitted as well as usual.
    """

    first: int
    last: int
    speed: float
    sigma: float
    noise: float
    distance: float
    course: float
    reason: str


def judge(path: Path, entry_cov: Array, bias_px: float, settings: SpeedSettings, trusted: NDArray[np.bool_]) -> Verdict:
    """Measure the mean speed over the longest stretch on which it is known well, and test the track.

    The stretch's ends may lie anywhere on the measured path; pose noise counts less with length, calibration doubt
    grows away from the surveyed points; `trusted` (T,) tells where the calibration holds. Well known is a doubt of
    GOOD_ENOUGH, or LONGER_FOR times the least, of a box that fits as well as usual.
    """
    position, velocity = path.planar.mean[:, :2], path.planar.mean[:, 2:]
    tangent = _tangents(velocity)
    length = way(position, tangent)
    first, last, sigma, noise = _best_stretch(path, length, tangent, entry_cov, bias_px, settings)
    duration = path.t[last] - path.t[first]
    distance = length[last] - length[first]
    speed = distance / duration if duration > 0 else 0.0
    moved = position[last] - position[first]
    course = float(np.arctan2(moved[1], moved[0]))
    verdict = Verdict(first, last, float(speed), float(sigma), float(noise), float(distance), course, "")
    return replace(verdict, reason=_reason(path, verdict, settings, bool((trusted & path.measured).any())))


def _best_stretch(
    path: Path, length: Array, tangent: Array, entry_cov: Array, bias_px: float, settings: SpeedSettings
) -> tuple[int, int, float, float]:
    """First and last state, and the deviations of the mean speed between them (m/s): whole, and as `Verdict.noise`."""
    seen = np.flatnonzero(path.measured) if path.measured.any() else np.arange(len(path.t))
    grid = np.unique(seen[np.linspace(0, len(seen) - 1, min(len(seen), 48)).astype(int)])
    i, j = (index.ravel() for index in np.meshgrid(grid, grid, indexing="ij"))
    duration, distance = path.t[j] - path.t[i], length[j] - length[i]
    allowed = (duration >= settings.min_duration_s) & (distance >= settings.min_distance_m)
    jumps = _jumps(path) > settings.max_acceleration
    gaps = np.zeros(len(path.t), dtype=int)
    gaps[seen[1:]] = np.diff(path.t[seen]) > UNSEEN_S
    broken = np.cumsum(jumps + gaps)
    whole = allowed & (broken[i] == broken[j]) & ~jumps[i]
    allowed = whole if whole.any() else allowed
    if not allowed.any():
        allowed = (i == grid[0]) & (j == grid[-1])
    i, j, duration, distance = i[allowed], j[allowed], duration[allowed], distance[allowed]
    along = np.einsum("ti,tij,tj->t", tangent, path.pose_cov[:, :2, :2], tangent)
    pose = along[i] + along[j]
    # d length / d H, summed up to each state: a stretch's share is the difference of two sums.
    steps = np.diff(path.calibration[:, :2], axis=0)
    pull = np.einsum("td,tdh->th", tangent[1:] + tangent[:-1], steps) / 2
    total = np.concatenate([np.zeros((1, 9)), np.cumsum(pull, axis=0)])
    g = total[j] - total[i]
    calibration = np.einsum("sh,hk,sk->s", g, entry_cov, g)
    slip = np.einsum("td,tdp->tp", tangent, path.pixel)  # m along the way for a pixel
    bias = bias_px**2 * np.sum((slip[j] - slip[i]) ** 2, axis=1)
    alike = np.exp(-duration / WANDER_S)[:, None] * slip[i] * slip[j]
    wander = WANDER_PX**2 * np.sum(slip[i] ** 2 + slip[j] ** 2 - 2 * alike, axis=1)
    stretch = np.einsum("td,tdp->tp", tangent, path.size_pull)  # m along the way for a metre of size
    doubt_of_size = np.hypot(path.size_sigma, SIZE_DOUBT * path.size)
    size = np.sum((doubt_of_size * (stretch[j] - stretch[i])) ** 2, axis=1)
    angle = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    turned = (TURN_M * (angle[j] - angle[i])) ** 2
    stamps = 2 * (distance / np.maximum(duration, 1e-9) * settings.sigma_t_s) ** 2
    own = pose + bias + wander + size + turned + stamps
    calibration = np.clip(calibration, 0, None)
    doubt = np.sqrt(own + calibration) / np.maximum(distance, 1e-3)
    good = doubt <= max(LONGER_FOR * float(doubt.min()), GOOD_ENOUGH)
    best = int(np.argmax(np.where(good, distance, -np.inf)))
    took, noise = max(duration[best], 1e-9), float(np.sqrt(own[best]))
    shared = calibration[best] + (path.clearance * distance[best]) ** 2
    sigma = float(np.sqrt((_doubt_of_outline(path) * noise) ** 2 + shared))
    return int(i[best]), int(j[best]), sigma / took, noise / took


def _doubt_of_outline(path: Path) -> float:
    """How many times as far as usual the outlines of a track lie off: as badly as its box fits, more amidst others."""
    times = path.misfit_px / USUAL_MISFIT_PX * np.exp(AMIDST * (1 - path.apart))
    return float(np.clip(times, LEAST_DOUBT, MOST_DOUBT)) if np.isfinite(times) else 1.0


def _tangents(velocity: Array) -> Array:
    """Unit directions (T, 2) of the way; what stands keeps the one it came with, so that its trembling is no way."""
    speed = np.linalg.norm(velocity, axis=1)
    moves = np.flatnonzero(speed > STANDS)
    if not len(moves):
        moves = np.array([int(np.argmax(speed))])
    last = moves[np.clip(np.searchsorted(moves, np.arange(len(speed)), side="right") - 1, 0, None)]
    return np.asarray(velocity[last] / np.maximum(speed[last], 1e-6)[:, None])


def _reason(path: Path, verdict: Verdict, settings: SpeedSettings, trusted: bool) -> str:
    """Why this track gets no speed; empty when it does. Nothing is clamped: a track is believed or rejected."""
    duration = path.t[verdict.last] - path.t[verdict.first]
    frames = int(path.measured[verdict.first : verdict.last + 1].sum())
    excess = float(np.max(_jumps(path)[verdict.first : verdict.last + 1], initial=0.0))
    refused = path.refused / max(1, path.refused + int(path.measured.sum()))
    if path.ended_by.startswith("part of"):
        return path.ended_by
    if not path.measured.any():  # hidden all the way through a region, say
        return "never seen: all of it is predicted"
    if not trusted:
        return "outside the trusted zone"
    if frames < settings.min_frames or duration < settings.min_duration_s:
        return f"too short: {frames} measured frames over {duration:.2f} s"
    if verdict.distance < settings.min_distance_m:
        return f"hardly moved: {verdict.distance:.1f} m"
    if path.measured.mean() < settings.min_measured:
        return f"seldom seen: measured in {100 * path.measured.mean():.0f} % of its frames"
    if path.ended_by in DOUBTFUL_ENDS and path.t[-1] - path.t[0] < SHORT_S:
        return f"{path.ended_by} after {path.t[-1] - path.t[0]:.1f} s"
    if excess > settings.max_acceleration:
        return f"jump: speed changes by more than {excess:.0f} m/s^2"
    if refused > settings.max_refused:
        return f"inconsistent: {100 * refused:.0f} % of the measurements outside the gate"
    if path.size_z > settings.max_size_z:
        length, width, height = path.size
        return f"no {path.class_name} measures {length:.1f} x {width:.1f} x {height:.1f} m: a part, or several"
    if evidence(path, verdict) < settings.min_evidence:
        found, free, filled = (f"{100 * share:.0f} %" for share in (path.support, path.apart, path.paint))
        return (
            f"too little seen: {found} of a {path.class_name}'s outline ({free} free of others), {filled} of its area"
        )
    outline = _outline_px(path)
    if np.isfinite(path.misfit_px) and path.misfit_px > settings.max_misfit * outline + 3:
        return f"no box fits: outline off by {path.misfit_px:.0f} px (several vehicles, a shadow or a reflection)"
    if verdict.sigma > settings.max_sigma * abs(verdict.speed):
        half = verdict.sigma * Z95 * KMH
        return f"too uncertain: {verdict.speed * KMH:.0f} +- {half:.0f} km/h"
    return ""


def evidence(path: Path, verdict: Verdict) -> float:
    """How much speaks for a track: its outline, apart from others and filled, how long it was seen, how exact its speed
    is and how usual its size."""
    seen = max(path.measured.mean() * (path.t[-1] - path.t[0]), SHORT_LOOK_S)
    noise = max(verdict.noise, 1e-9) / max(verdict.speed, SLOW)
    odd = LIKE_A_PART if is_slim(path.size) else ODD * path.size_z
    shown = path.support + APART * path.apart + SOLID * path.paint
    return float(shown + LASTING * np.log(seen / SHORT_LOOK_S) - EXACT * np.log(noise / USUAL_NOISE) - odd)


def _jumps(path: Path) -> Array:
    """Change of speed (T,) m/s^2 around each state, over JUMP_S, that its uncertainty does not explain."""
    t = path.t
    speed = np.linalg.norm(path.planar.mean[:, 2:], axis=1)
    sigma = np.sqrt(np.trace(path.planar.cov[:, 2:, 2:], axis1=1, axis2=2))
    excess = np.zeros(len(t))
    reach = max(1, round(JUMP_S / float(np.median(np.diff(t))))) if len(t) > 2 else len(t)
    if reach < len(t):
        gained = speed[reach:] - speed[:-reach]
        change = np.abs(gained) * np.where(gained > 0, SUDDEN, 1.0)
        change = np.maximum(change - 2 * (sigma[reach:] + sigma[:-reach]), change / 2)  # no doubt explains everything
        excess[reach // 2 : len(t) - reach + reach // 2] = change / (t[reach:] - t[:-reach])
    return np.asarray(maximum_filter1d(excess, 3 * reach + 1))  # smoothing bends the path around a jump as well


def _outline_px(path: Path) -> float:
    """Typical size of the target in the image (px)."""
    scale = np.sqrt(np.abs(np.linalg.det(path.pixel)))  # m per px
    return float(np.median(path.size[2] / np.maximum(scale, 1e-9)))
