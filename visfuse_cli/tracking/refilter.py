"""The filter run again over the settled poses of tracks that have ended, all of them in step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.gaussian import mahalanobis
from visfuse_cli.records import Array, Gaussian
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import measure
from visfuse_cli.tracking.dynamics import Dynamics, Prediction, Step
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.targets import Sample

START_DOUBT = 5.0  # times the deviations a new track begins with
SETTLING = 12  # measurements until that doubt is gone
START_S, LEAST_START = 1.5, 5  # s, and measurements, from which the start is estimated
ASTRAY = 10  # measurements outside the gate, one after another, after which they are right and the belief is not
LEAST_TOLD = 5  # innovations that tell the noise

Measured = tuple[Array, Array]  # z (m,) and R (m, m)


@dataclass(frozen=True, slots=True)
class Poses:
    """The settled poses of a track: times (T,) s, what was measured then, where it began, and its length (m)."""

    t: Array
    measured: list[Measured | None]
    start: Gaussian
    length: float


@dataclass(slots=True)
class Refiltered:
    """The steps over the poses of a track, which (T,) of them lay inside the gate, and the noise that the innovations
    of the whole track speak of as a share of what was expected."""

    steps: list[Step]
    trusted: NDArray[np.bool_]
    noise: float = 1.0


def settled_poses(
    samples: list[Sample], steps: list[Step], fit: measure.BoxFit, pose: Array, size: Array, dynamics: Dynamics
) -> Poses:
    """What the boxes of a size (3,) say that were fitted around the poses (T, 3) of a track."""
    z, R = dynamics.measured(*measure.measurements(fit, pose))
    measured = [(z[k], R[k]) if sample.measured and fit.ok[k] else None for k, sample in enumerate(samples)]
    t = np.array([sample.t for sample in samples])
    start = _start(t, measured, pose, dynamics) or steps[0].posterior
    # It begins knowing nearly nothing.
    return Poses(t, measured, Gaussian(start.mean, start.cov * START_DOUBT**2), float(size[0]))


def filter_again(tracks: Sequence[Poses], settings: TrackerSettings, dynamics: Dynamics) -> list[Refiltered]:
    """Filter settled poses; a second time with the noise that the innovations of each whole track speak of."""
    noise, found = np.ones(len(tracks)), []
    for _ in range(2 if settings.filter.adapt_noise else 1):
        found = _in_step(tracks, noise, gate_size(len(dynamics.H), settings.pose.gate), dynamics)
        for k, each in enumerate(found):
            nis = nis_of(each.steps)
            if len(nis) >= LEAST_TOLD:
                noise[k] *= float(np.clip(np.mean(nis) / len(dynamics.H), 0.2, 25.0))
            each.noise = float(noise[k])
    return found


def nis_of(steps: list[Step]) -> Array:
    """The squared innovations in units of their deviation, (n,), of the steps in which something was measured."""
    return np.array([float(step.innovation.nis) for step in steps if step.innovation is not None])


def _start(t: Array, measured: list[Measured | None], pose: Array, dynamics: Dynamics) -> Gaussian | None:
    """Where and how fast a track began, by medians over its first measurements: what enters is badly seen at first."""
    used = np.array([z is not None for z in measured]) & (t - t[0] <= START_S)
    if np.count_nonzero(used) < LEAST_START:
        return None
    elapsed = t[used] - t[0]
    position = np.array([z[0][:2] for z, chosen in zip(measured, used, strict=True) if z is not None and chosen])
    i, j = np.triu_indices(len(elapsed), 1)
    velocity = np.median((position[j] - position[i]) / (elapsed[j] - elapsed[i])[:, None], axis=0)
    begin = np.median(position - elapsed[:, None] * velocity, axis=0)
    heading = np.arctan2(np.median(np.sin(pose[used, 2])), np.median(np.cos(pose[used, 2])))
    return dynamics.begin(np.append(begin, heading), velocity)


def _in_step(tracks: Sequence[Poses], noise: Array, gate: float, dynamics: Dynamics) -> list[Refiltered]:
    """One pass over the poses of all tracks, the k-th frames of those that last so long together."""
    found = [
        Refiltered([dynamics_tools.first(dynamics, track.start)], np.zeros(len(track.t), dtype=bool))
        for track in tracks
    ]
    count, astray = [0] * len(tracks), [0] * len(tracks)  # measurements since it began, and the last outside the gate
    for k in range(max(len(track.t) for track in tracks)):
        alive = [i for i, track in enumerate(tracks) if k < len(track.t)]
        # The record of residuals begins when the belief has settled: the first doubt is no sign of a manoeuvre.
        last = [found[i].steps[-1] for i in alive]
        before = [
            step if count[i] > SETTLING else replace(step, memory=None) for i, step in zip(alive, last, strict=True)
        ]
        dt = np.array([tracks[i].t[k] - tracks[i].t[k - 1] if k else 0.0 for i in alive])
        expected = dynamics_tools.predict(dynamics, before, dt, np.array([tracks[i].length for i in alive]))
        seen: list[tuple[int, Prediction, Measured]] = []
        for i, prediction in zip(alive, expected, strict=True):
            if astray[i] >= ASTRAY:
                count[i], astray[i], prediction = 0, 0, _begun_again(prediction, tracks[i].start)
            found[i].steps.append(dynamics_tools.coast(prediction))
            if (now := tracks[i].measured[k]) is not None:
                seen.append((i, prediction, now))
        if not seen:
            continue
        which = [i for i, *_ in seen]
        taken, close = _taken(dynamics, [each for _, each, _ in seen], [now for *_, now in seen], noise[which], gate)
        for i, step, trusted in zip(which, taken, close, strict=True):
            found[i].steps[-1], found[i].trusted[k] = step, trusted
            count[i] += 1
            astray[i] = 0 if trusted else astray[i] + 1
    for each in found:
        del each.steps[0]  # before the first frame
    return found


def _begun_again(expected: Prediction, start: Gaussian) -> Prediction:
    """What is expected of a target, with the doubt of one that has just begun."""
    return replace(expected, prior=Gaussian(expected.prior.mean, expected.prior.cov + start.cov), memory=None)


def _taken(
    dynamics: Dynamics, expected: list[Prediction], now: list[Measured], noise: Array, gate: float
) -> tuple[list[Step], NDArray[np.bool_]]:
    """Steps of n targets with what was measured, and which of them lie inside the gate."""
    z, R = np.array([z for z, _ in now]), np.array([R for _, R in now]) * noise[:, None, None]
    H, prior = dynamics.H, dynamics_tools.stacked([each.prior for each in expected])
    gamma = dynamics_tools.residual(dynamics, z, prior.mean)
    nis = mahalanobis(gamma, H @ prior.cov @ H.T + R)
    # Outside the gate a measurement counts less the further off it is: a bad start is left behind in the end.
    R = R * np.maximum(1.0, nis / gate)[:, None, None] ** 2
    return dynamics_tools.take_each(dynamics, expected, z, R), np.asarray(nis < gate)
