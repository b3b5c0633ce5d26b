"""A new thing followed back through the last seconds, to where it was first seen."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.cameras import ground_scale, project
from visfuse_cli.maths.gaussian import mahalanobis
from visfuse_cli.records import Array, Boxes, GroundCamera
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import hypotheses, measure
from visfuse_cli.tracking.dynamics import Dynamics
from visfuse_cli.tracking.evidence import Evidence, probe_each
from visfuse_cli.tracking.hypotheses import Guess
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.targets import Sample
from visfuse_cli.vision import wireframe

REACH_PX = (4.0, 20.0)
PROOF, PROVEN = 10, 0.5  # frames after which a thing that was seen in few of them is none
AT_ONCE = 5  # frames that are looked at together: what is expected in them differs little
LOST_S = 0.5  # s without the thing: it was not there before

Recent = deque[tuple[int, float, Evidence]]  # frame, t and what it showed, oldest first


def trace(
    camera: GroundCamera,
    settings: TrackerSettings,
    dynamics: Dynamics,
    recent: Recent,
    taken_at: Callable[[int], Boxes],
    guess: Guess,
    velocity: Array,
    beyond_doubt: bool = True,
) -> tuple[list[Sample], Array]:
    """Samples of a thing from where it was first seen to the last frame of `recent`, and its poses there (n, 3).

    Time runs backwards: to the motion model it is the same thing driving away the other way round.
    """
    way = _Way(camera, settings, dynamics, guess, velocity, recent[-1][1], beyond_doubt)
    frames = list(reversed(recent))
    for first in range(0, len(frames), AT_ONCE):
        if not way.follow(frames[first : first + AT_ONCE], taken_at):
            break
    return way.path()


class _Way:
    """One thing on its way back: what was seen of it so far, the last first."""

    def __init__(
        self,
        camera: GroundCamera,
        settings: TrackerSettings,
        dynamics: Dynamics,
        guess: Guess,
        velocity: Array,
        t: float,
        beyond_doubt: bool,
    ) -> None:
        self._beyond_doubt = beyond_doubt
        self._camera, self._settings, self._dynamics, self._guess = camera, settings, dynamics, guess
        turned = np.array([guess.pose[0], guess.pose[1], guess.pose[2] + np.pi])
        self._step = dynamics_tools.first(dynamics, dynamics.begin(turned, -velocity))
        self._gate = gate_size(len(dynamics.H), settings.pose.gate)
        self._before = self._last_seen = t
        self._samples: list[Sample] = []
        self._poses: list[Array] = []

    def path(self) -> tuple[list[Sample], Array]:
        """Samples and poses (n, 3) from the first one that was measured on, in the order of time."""
        first = next((k for k, sample in enumerate(self._samples[::-1]) if sample.measured), len(self._samples))
        return self._samples[::-1][first:], np.array(self._poses[::-1][first:]).reshape(-1, 3)

    def follow(self, frames: list[tuple[int, float, Evidence]], taken_at: Callable[[int], Boxes]) -> bool:
        """Look for the thing in a few earlier frames at once; False where its way ends."""
        pose, reach, whole = self._expected(np.array([t for _, t, _ in frames]))
        frames = frames[: len(pose)]
        if not frames:
            return False
        size = np.tile(self._guess.size, (len(frames), 1))
        taken = [taken_at(frame) for frame, _, _ in frames]
        look = probe_each([evidence for *_, evidence in frames], pose, size, reach, taken)
        fit = measure.fit_poses(self._camera, look.outlines, pose, size, self._guess.size_sigma, self._settings.pose)
        there = fit.ok & measure.looks_right(fit, look.outlines) & hypotheses.seen(look, self._beyond_doubt)
        there &= look.open > hypotheses.LEAST_OPEN
        border = look.border * fit.agreed
        z, R = self._dynamics.measured(*measure.measurements(fit, pose))
        for k, (frame, t, _) in enumerate(frames):
            if self._last_seen - t > LOST_S:
                return False
            seen = self._take(t, (z[k], R[k]) if there[k] else None)
            self._samples.append(Sample.of(frame, t, look, k, border, seen))
            mean = self._step.posterior.mean
            self._poses.append(np.array([mean[0], mean[1], self._dynamics.heading(mean) - np.pi]))
            if len(self._samples) == PROOF and sum(sample.measured for sample in self._samples) < PROVEN * PROOF:
                self._samples, self._poses = [], []
                return False
        return whole

    def _expected(self, t: Array) -> tuple[Array, Array, bool]:
        """Poses (n, 3) and reaches (n,) px at the times t (s) before it leaves the picture, and whether it does not."""
        camera, size = self._camera, self._guess.size
        count = len(t)
        ahead = dynamics_tools.predict(self._dynamics, [self._step] * count, self._before - t, np.full(count, size[0]))
        mean = np.array([each.prior.mean for each in ahead])
        pose = np.column_stack([mean[:, :2], self._dynamics.heading(mean) - np.pi])
        pixels, _ = project(camera, wireframe.corners(pose, np.tile(size, (count, 1))))
        foot, J = project(camera, np.column_stack([pose[:, :2], np.zeros(count)]))
        low, high = pixels.min(axis=1), pixels.max(axis=1)
        inside = np.all((high > 0) & (low < camera.image_size), axis=1)
        inside &= ground_scale(camera, foot) < self._settings.life.max_scale
        end = count if inside.all() else int(np.argmin(inside))
        cov = np.array([each.prior.cov[:2, :2] for each in ahead])
        spread = np.sqrt(np.einsum("nij,njk,nik->n", J[:, :, :2], cov, J[:, :, :2]))
        return pose[:end], np.clip(3 * spread[:end], *REACH_PX), end == count

    def _take(self, t: float, measured: tuple[Array, Array] | None) -> bool:
        """Go back to t (s), with what was measured there if that fits; whether it did."""
        dynamics, length = self._dynamics, self._guess.size[:1]
        expected = dynamics_tools.predict(dynamics, [self._step], np.array([self._before - t]), length)[0]
        self._before, self._step = t, dynamics_tools.coast(expected)
        if measured is None:
            return False
        z, R = measured
        z[2:] += np.pi  # the heading, where it is measured
        gamma = dynamics_tools.residual(dynamics, z, expected.prior.mean)
        if mahalanobis(gamma, dynamics.H @ expected.prior.cov @ dynamics.H.T + R) >= self._gate:
            return False
        self._step, self._last_seen = dynamics_tools.take(dynamics, expected, z, R), t
        return True
