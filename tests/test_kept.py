"""What is kept of every frame until a track has ended: exact, enough for the backward pass, and little."""

import gc
import tracemalloc
from contextlib import nullcontext

import cv2
import numpy as np
import pytest

from visfuse_cli.gazing.head import Head as GroundHead
from visfuse_cli.gazing.models import Courses
from visfuse_cli.gazing.tracker import Tracker as GroundTracker
from visfuse_cli.maths import imm
from visfuse_cli.maths.gaze import ORDERS
from visfuse_cli.maths.odometry import Poses
from visfuse_cli.moving.journey import Ride
from visfuse_cli.moving.models import Models
from visfuse_cli.moving.settings import FilterSettings, ImmConfig
from visfuse_cli.moving.tracker import Tracker
from visfuse_cli.records import Gaussian, GivenTarget, Lens, StereoRig

SIZE = (128, 112)
QUAD = np.array([[50.0, 30], [80, 30], [80, 80], [50, 80]])


@pytest.mark.parametrize(("kind", "dimensions", "size"), [(Models, 3, 12), (Courses, 2, 6)])
def test_banks_come_back_as_they_were_and_the_steps_between_them_are_made_again(kind, dimensions, size):
    rng, models = np.random.default_rng(5), kind(FilterSettings())
    times = np.cumsum(rng.uniform(0.03, 0.1, 15))
    first = models.start(*(Gaussian(mean, np.eye(dimensions)) for mean in rng.normal(size=(2, dimensions))))
    banks, steps = models.kept(first), {}
    bank = first
    for k, dt in enumerate(np.diff(times), start=1):
        step = models.predict(bank, float(dt))
        if k % 3:
            residual = 0.05 * rng.normal(size=(len(models.names), 2))
            step, _ = imm.update(step, residual, np.eye(2, size), 0.01 * np.eye(2))
        steps[k], bank = step, step.filtered
        banks.append(bank)
    assert len(banks) == 15
    for k, back in enumerate(list(banks.backward(15))[::-1]):
        same(back, steps[k].filtered if k else first)
    wanted = imm.backward(
        15,
        lambda k: steps[k].filtered if k else first,
        lambda k, _: (steps[k], imm.changes(len(models.names), times[k] - times[k - 1], FilterSettings().sojourn)),
        (3,) if kind is Courses else (),
    )
    for one, other in zip(models.smoothed(banks, times), wanted, strict=True):
        same(one, other, 1e-9)  # where arrays lie in memory decides on the last bit of a product


def same(one, other, rtol=1e-12):
    np.testing.assert_allclose(one.beliefs.mean, other.beliefs.mean, rtol, rtol / 1e3)
    np.testing.assert_allclose(one.beliefs.cov, other.beliefs.cov, rtol, rtol / 1e3)
    np.testing.assert_allclose(one.log_mu, other.log_mu, rtol, rtol)


def wall(shift):
    """A patterned wall (H, W, 3), seen `shift` px further to the right."""
    pattern = np.random.default_rng(1).integers(0, 256, (SIZE[1], SIZE[0] + 40, 3), np.uint8)
    return np.ascontiguousarray(cv2.GaussianBlur(pattern, (0, 0), 2.5)[:, shift : shift + SIZE[0]])


def stereo(config):
    """A tracker of a named part of a wall 4 m ahead, stepped by frame number."""
    lens = Lens(np.array([[160.0, 0, 64], [0, 160, 56], [0, 0, 1]]), np.zeros(5))
    rig = StereoRig(lens, lens, np.eye(3), np.array([-0.2, 0, 0]), None)
    tracker = Tracker(rig, config, SIZE, [GivenTarget(0, QUAD, None, None)], lambda name: nullcontext())
    ride = Ride(lambda t: Poses(np.array([t]), np.eye(3)[None], np.zeros((1, 3)), np.zeros(1), np.zeros((1, 4, 4))))
    pictures = {"left": wall(0), "right": wall(8)}
    return tracker, lambda k: tracker.step(pictures, k, ride.look(k, k / 16))


def pan_tilt(config):
    """A tracker of a named part of a wall, at the foot of it 8 m before a head 4 m over the ground."""
    lens = Lens(np.array([[160.0, 0, 64], [0, 160, 56], [0, 0, 1]]), np.zeros(5))
    level = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # x right, y ahead, z up -> right, down, ahead
    down = cv2.Rodrigues(np.array([0.4, 0, 0]))[0] @ level
    head = GroundHead(np.column_stack([down, down @ [0, 0, -4.0]]), np.array([0, 0, 4.0]), lens, ORDERS[0])
    tracker = GroundTracker(head, config, SIZE, [GivenTarget(0, QUAD, None, None)], lambda name: nullcontext())
    return tracker, lambda k: tracker.step(wall(0), k, k / 16, np.zeros(2))


@pytest.mark.parametrize(("head", "most"), [(stereo, 3000), (pan_tilt, 2000)])
def test_a_frame_leaves_few_bytes_behind(head, most):
    tracker, step = head(ImmConfig(latency=0.1))
    tracemalloc.start()
    try:
        kept = []
        for k in range(61):
            step(k)
            if k in (20, 60):
                gc.collect()
                kept.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    (target,) = tracker.finish()
    assert len(target.banks) == 61
    assert target.measured
    assert (kept[1] - kept[0]) / 40 < most
