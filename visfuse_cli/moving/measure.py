"""What a pair of pictures says of a target in the world, and the beliefs after it."""

from __future__ import annotations

import numpy as np

from visfuse_cli.maths import imm
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.imm import Step
from visfuse_cli.maths.planes import in_right, projected
from visfuse_cli.moving.head import Head, Pair
from visfuse_cli.moving.models import SIZE, P, V
from visfuse_cli.moving.settings import MeasureSettings
from visfuse_cli.records import Array, StereoRig
from visfuse_cli.vision import patches
from visfuse_cli.vision.disparity import region_shift

STEP = 1e-3  # m, m/s: of the numerical Jacobian
# A measurement outside of the first gate is believed less, LIMBS times the noise: limbs, wind, a template that slips.
GATES, LIMBS = (1 - 1e-3, 1 - 1e-7), 25.0
FLOW_RIM = 4.0  # px from the edge of the picture, within which there is no saying what its flow is


def across(rig: StereoRig, pair: Pair, left: Array, right: Array, reach: float) -> tuple[Array, Array] | None:
    """The right quad (4, 2) of a left one, near `right` on the epipolar line, and the variances (2,) of its place."""
    ray = np.append(left.mean(axis=0), 1.0) @ np.linalg.inv(rig.left.K).T
    far, near = projected(rig.right.K, in_right(rig, ray * np.array([[200.0], [100.0]])))
    along = near - far
    if not np.isfinite(along).all() or np.linalg.norm(along) < 1e-9:
        return None
    return region_shift(pair.pictures, left, right, along / np.linalg.norm(along), reach)


def measurement(
    settings: MeasureSettings, left: Array, right: Array, noise: Array, flow: Array | None
) -> tuple[Array, Array]:
    """z (5,): flow (2,) px a frame, disparity, middle (2,) px; and its noise (5, 5). Jia 2008, eq. 17."""
    u, v = left.mean(axis=0)
    z = np.array([0.0, 0.0, u - right[:, 0].mean(), u, v])
    R = np.zeros((5, 5))
    R[2, 2] = noise[2, 2] + settings.disparity_sigma**2
    R[3:, 3:] = noise[:2, :2] + settings.place_sigma**2 * np.eye(2)
    mean = None if flow is None else _mean_flow(left, flow)  # what runs out of the picture has no flow
    if mean is None:
        R[:2, :2] = 1e6 * np.eye(2)
    else:
        z[:2] = mean
        R[:2, :2] = settings.flow_sigma**2 * np.eye(2)
    return z, R


def _mean_flow(quad: Array, flow: Array) -> Array | None:
    """The median flow (2,) px inside the inner half of a quad; None at the picture's edge."""
    if not patches.inside(quad, (flow.shape[1], flow.shape[0]), FLOW_RIM):
        return None
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


def updated(rig: StereoRig, step: Step, z: Array, R: Array, head: Head, before: Head) -> tuple[Step, float] | None:
    """The step after the measurement, and how far that was off; None where no model can believe it."""
    change = STEP * np.eye(6, SIZE)
    tried = step.predicted.mean[:, None] + np.concatenate([np.zeros((1, SIZE)), change, -change])  # (r, 13, 12)
    h = expected(rig, tried, head, before)
    if not np.isfinite(h).all():
        return None
    J = np.zeros((len(h), len(z), SIZE))
    J[:, :, :6] = np.swapaxes(h[:, 1:7] - h[:, 7:], 1, 2) / (2 * STEP)
    for gate, times in zip(GATES, (1.0, LIMBS), strict=True):
        after, innovation = imm.update(step, z - h[:, 0], J, times * R)
        if innovation.nis.min() <= gate_size(len(z), gate):
            return after, float(np.exp(after.filtered.log_mu) @ innovation.nis)
    return None
