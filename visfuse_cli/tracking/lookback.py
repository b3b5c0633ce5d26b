"""A new thing followed back through the last seconds, to where it was first seen."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.cameras import ground_scale, project
from visfuse_cli.maths.gaussian import mahalanobis
from visfuse_cli.records import Array, GroundCamera
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import hypotheses, measure
from visfuse_cli.tracking.dynamics import Dynamics
from visfuse_cli.tracking.evidence import Boxes, Evidence
from visfuse_cli.tracking.hypotheses import Guess
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.targets import Sample
from visfuse_cli.vision import wireframe

REACH_PX = (4.0, 20.0)
LEAST_OPEN = 0.2  # of a box in view to measure it
PROOF, PROVEN = 10, 0.5  # frames after which a thing that was seen in few of them is none
LOST_S = 0.3  # s without the thing: it was not there before

Recent = deque[tuple[int, float, Evidence]]  # frame, t and what it showed, oldest first


def trace(
    camera: GroundCamera,
    settings: TrackerSettings,
    dynamics: Dynamics,
    recent: Recent,
    taken_at: Callable[[int], Boxes],
    guess: Guess,
    velocity: Array,
) -> tuple[list[Sample], Array]:
    """Samples of a thing from where it was first seen to the last frame of `recent`, and its poses there (n, 3).

    Time runs backwards: to the motion model it is the same thing driving away the other way round.
    """
    turned = np.array([guess.pose[0], guess.pose[1], guess.pose[2] + np.pi])
    step = dynamics_tools.first(dynamics, dynamics.begin(turned, -velocity))
    gate = gate_size(len(dynamics.H), settings.pose.gate)
    before = last_seen = recent[-1][1]
    samples: list[Sample] = []
    poses: list[Array] = []
    for frame, t, evidence in reversed(recent):
        expected = dynamics_tools.predict(dynamics, [step], np.array([before - t]), guess.size[:1])[0]
        mean = expected.prior.mean
        pose = np.array([[mean[0], mean[1], dynamics.heading(mean) - np.pi]])
        size = guess.size[None]
        pixels, _ = project(camera, wireframe.corners(pose, size)[0])
        foot, J = project(camera, np.append(pose[0, :2], 0.0)[None])
        scale = ground_scale(camera, foot)[0]
        outside = not np.all((pixels.max(axis=0) > 0) & (pixels.min(axis=0) < camera.image_size))
        if outside or not scale < settings.life.max_scale or last_seen - t > LOST_S:
            break
        if len(samples) == PROOF and sum(sample.measured for sample in samples) < PROVEN * PROOF:
            return [], np.zeros((0, 3))
        spread = np.sqrt(np.trace(J[0, :, :2] @ expected.prior.cov[:2, :2] @ J[0, :, :2].T))
        look = evidence.probe(pose, size, np.clip(3 * spread, *REACH_PX)[None], taken_at(frame))
        fit = measure.fit_poses(camera, look.outlines, pose, size, guess.size_sigma, settings.pose)
        step = dynamics_tools.coast(expected)
        seen = bool(
            fit.ok[0]
            & measure.looks_right(fit, look.outlines)[0]
            & hypotheses.convincing(look)[0]
            & (look.open[0] > LEAST_OPEN)
        )
        if seen:
            z, R = dynamics.measured(*measure.measurement(fit, 0, pose[0]))
            z[2:] += np.pi  # the heading, where it is measured
            gamma = dynamics_tools.residual(dynamics, z, mean)
            seen = bool(mahalanobis(gamma, dynamics.H @ expected.prior.cov @ dynamics.H.T + R) < gate)
            if seen:
                step = dynamics_tools.take(dynamics, expected, z, R)
                last_seen = t
        samples.append(Sample(frame, t, look.outlines[0], float(look.border[0] * fit.agreed[0]), seen))
        after = step.posterior.mean
        poses.append(np.array([after[0], after[1], dynamics.heading(after) - np.pi]))
        before = t
    while samples and not samples[-1].measured:
        samples.pop()
        poses.pop()
    return samples[::-1], np.array(poses[::-1]).reshape(-1, 3)
