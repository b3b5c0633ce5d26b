"""Motion models, interacting models, odometry, flow, clusters: the oracles of the papers' equations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visfuse_cli.maths import course, gaussian, imm, motion, odometry
from visfuse_cli.maths.imm import Extension
from visfuse_cli.maths.smoothing import rauch_tung_striebel
from visfuse_cli.moving.models import Models
from visfuse_cli.moving.settings import FilterSettings
from visfuse_cli.records import Gaussian
from visfuse_cli.vision import clusters, flow

pytestmark = pytest.mark.geometry


def test_periodic_motion_keeps_its_energy_and_the_eulerian_one_grows():
    w, dt = 1.3, 0.1
    x = np.array([1.0, 0.4, 0.2])  # position, velocity, centre
    exact, euler = x.copy(), x.copy()
    for _ in range(200):
        exact = motion.periodic(dt, w, 1) @ exact
        euler = motion.periodic(dt, w, 1, euler=True) @ euler
    energy = [(s[0] - s[2]) ** 2 * w**2 + s[1] ** 2 for s in (x, exact, euler)]
    assert energy[1] == pytest.approx(energy[0], rel=1e-9)
    assert energy[2] == pytest.approx(energy[0] * (1 + (w * dt) ** 2) ** 200, rel=1e-6)


@pytest.mark.parametrize(
    ("F", "Q"),
    [
        (lambda dt: motion.constant_velocity(dt, 2), lambda dt: motion.constant_velocity_noise(dt, 0.7, 2)),
        (lambda dt: motion.constant_acceleration(dt, 2), lambda dt: motion.constant_acceleration_noise(dt, 0.7, 2)),
        (lambda dt: motion.periodic(dt, 1.7, 2), lambda dt: motion.periodic_noise(dt, 1.7, 0.7, 0.1, 2)),
    ],
)
def test_a_step_in_two_is_a_step(F, Q):
    one = Q(0.5)
    two = F(0.3) @ Q(0.2) @ F(0.3).T + Q(0.3)
    np.testing.assert_allclose(two, one, atol=1e-12)
    np.testing.assert_allclose(F(0.3) @ F(0.2), F(0.5), atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.floats(-3, 3), st.floats(-2, 2), st.floats(0.1, 8), st.sampled_from([course.CSD, course.CS, course.CD]))
def test_the_jacobians_of_speed_and_course_are_the_differences(theta, rate, s, kind):
    x = np.array([1.0, 2, s, theta, 0.3, rate])
    _, F = course.advance(x, np.array(0.2), kind)
    for k in range(6):
        h = np.zeros(6)
        h[k] = 1e-6
        up, down = (course.advance(x + sign * h, np.array(0.2), kind)[0] for sign in (1, -1))
        difference = up - down
        difference[3] = np.angle(np.exp(1j * difference[3]))
        np.testing.assert_allclose(F[:, k], difference / 2e-6, atol=1e-6)


def test_constant_speed_goes_over_into_a_straight_as_the_rate_vanishes():
    x = np.array([0.0, 0, 2, 0.7, 0, 1e-9])
    turned, straight = (course.advance(x, np.array(0.5), kind)[0] for kind in (course.CS, course.CSD))
    np.testing.assert_allclose(turned[:4], straight[:4], atol=1e-8)


def test_copies_of_one_model_are_that_models_kalman_filter():
    rng = np.random.default_rng(2)
    F, Q, H, R = (
        motion.constant_velocity(0.1, 2),
        motion.constant_velocity_noise(0.1, 0.5, 2),
        np.eye(2, 4),
        0.04 * np.eye(2),
    )
    extension = Extension((0, 1, 2, 3), np.ones(4))
    single = Gaussian(np.zeros(4), np.eye(4))
    beliefs, log_mu = [single] * 3, np.log(np.array([0.2, 0.5, 0.3]))
    log_p = imm.transition(3, 0.9)
    for _ in range(20):
        z = rng.normal(size=2)
        single = gaussian.predict(single, F, Q)
        single, _ = gaussian.update(single, z - single.mean[:2], H, R)
        beliefs, ahead = imm.mix(beliefs, log_mu, log_p, [extension] * 3)
        found = [gaussian.update(p, z - p.mean[:2], H, R) for p in (gaussian.predict(b, F, Q) for b in beliefs)]
        beliefs = [b for b, _ in found]
        log_mu = imm.weigh(ahead, np.array([float(i.log_likelihood) for _, i in found]))
        assert np.exp(log_mu).sum() == pytest.approx(1)
    both = imm.combined(beliefs, log_mu, [extension] * 3)
    np.testing.assert_allclose(both.mean, single.mean, atol=1e-10)
    np.testing.assert_allclose(both.cov, single.cov, atol=1e-10)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000))
def test_mixing_leaves_the_mean_of_what_is_common_unchanged(seed):
    rng = np.random.default_rng(seed)
    variance = np.repeat([1.0, 4.0, 9.0], 2)
    short, long = Extension((0, 1, 2, 3), variance), Extension(tuple(range(6)), variance)

    def belief(n):
        A = rng.normal(size=(n, n))
        return Gaussian(rng.normal(size=n), A @ A.T + np.eye(n))

    beliefs, log_mu = [belief(4), belief(6)], np.log(np.array([0.3, 0.7]))
    mixed, ahead = imm.mix(beliefs, log_mu, imm.transition(2, 0.8), [short, long])
    before = 0.3 * beliefs[0].mean + 0.7 * beliefs[1].mean[:4]
    c = np.exp(ahead)
    np.testing.assert_allclose(c[0] * mixed[0].mean + c[1] * mixed[1].mean[:4], before, atol=1e-10)
    for each in mixed:
        assert np.linalg.eigvalsh(each.cov).min() > 0


def test_with_one_model_the_backward_pass_is_rauch_tung_striebels():
    rng = np.random.default_rng(4)
    models = Models(FilterSettings(kind="cv"))
    bank = models.start(Gaussian(np.zeros(3), np.eye(3)), np.zeros(3))
    steps, filtered, predicted = [], [], []
    H, R = np.eye(3, 6), 0.01 * np.eye(3)
    F = motion.constant_velocity(0.1, 3)
    for k in range(15):
        ahead, step = models.predict(bank, 0.1)
        z = np.array([0.1 * k, 0, 0]) + 0.1 * rng.normal(size=3)
        after, _ = gaussian.update(ahead.beliefs[0], z - ahead.beliefs[0].mean[:3], H, R)
        predicted.append(ahead.beliefs[0])
        filtered.append(after)
        bank = type(bank)((after,), bank.log_mu)
        steps.append(type(step)(step.mixed, step.F, step.predicted, bank, step.ahead))
    stack = [Gaussian(np.stack([b.mean for b in bs]), np.stack([b.cov for b in bs])) for bs in (filtered, predicted)]
    wanted = rauch_tung_striebel(stack[0], stack[1], np.tile(F, (15, 1, 1)))
    found, _ = models.smoothed(steps)
    np.testing.assert_allclose(np.stack([b.mean[:6] for b in found]), wanted.mean, atol=1e-9)
    np.testing.assert_allclose(np.stack([b.cov[:6, :6] for b in found]), wanted.cov, atol=1e-9)


def test_wheels_on_a_closed_circle_return_to_their_start():
    t = np.linspace(0, 20, 401)
    radius, b = 3.0, 0.5
    w = 2 * np.pi / 20
    v = np.full_like(t, radius * w)
    heading, place = odometry.driven(t, v - w * b / 2, v + w * b / 2, b, t)
    np.testing.assert_allclose(place[-1], place[0], atol=1e-9)
    assert heading[-1] == pytest.approx(2 * np.pi)
    assert heading[50] > 0  # the right wheel faster: to the left
    assert place[50, 0] < 0


def test_the_optical_axis_and_the_pitch_are_the_contracts():
    R = odometry.rotation(np.array(0.3), 0.1)
    np.testing.assert_allclose(
        R[:, 2], [-np.sin(0.3) * np.cos(0.1), -np.sin(0.1), np.cos(0.3) * np.cos(0.1)], atol=1e-12
    )
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)


def test_a_camera_beside_the_axle_is_carried_by_the_turn():
    t = np.linspace(0, 2, 41)
    w, b = 0.5, 0.4
    poses = odometry.from_wheels(
        t, np.full(41, -w * b / 2), np.full(41, w * b / 2), b, 0.2, np.array([0.3, -0.5, 0.1]), t, (0, 0)
    )
    np.testing.assert_allclose(np.linalg.norm(poses.T[:, [0, 2]], axis=1), np.hypot(0.3, 0.1), atol=1e-12)
    np.testing.assert_allclose(poses.theta, w * t + 0.2, atol=1e-12)


def test_horn_schunck_sees_a_shift_of_several_pixels():
    rng = np.random.default_rng(3)
    import cv2

    base = cv2.GaussianBlur(rng.uniform(0, 255, (140, 180)).astype(np.float32), (0, 0), 2.0)
    base = (base - base.min()) / np.ptp(base) * 255
    M = np.array([[1, 0, 3.4], [0, 1, -1.7]])
    moved = cv2.warpAffine(base, M, (180, 140), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    found = flow.horn_schunck(base.astype(np.uint8), moved.astype(np.uint8), 8.0, 40, 1.0)[20:-20, 20:-20]
    error = np.linalg.norm(found - [3.4, -1.7], axis=-1)
    assert error.mean() < 0.15
    fast = flow.dis(base.astype(np.uint8), moved.astype(np.uint8))[20:-20, 20:-20]
    assert np.linalg.norm(fast - [3.4, -1.7], axis=-1).mean() < 0.3


def test_own_motion_is_the_flow_of_static_points():
    K = np.array([[220.0, 0, 40], [0, 220, 30], [0, 0, 1]])
    R, t = odometry.rotation(np.array(0.02)).T, np.array([0.05, 0.0, -0.1])
    depth = np.full((60, 80), 4.0)
    found = flow.own_motion(depth, K, R, t)
    point = np.array([(13 - 40) / 220, (50 - 30) / 220, 1]) * 4
    seen = R @ point + t
    np.testing.assert_allclose(found[50, 13], seen[:2] / seen[2] * 220 + [40, 30] - [13, 50], atol=1e-9)
    far = flow.own_motion(np.full((60, 80), np.inf), K, R, t)
    np.testing.assert_allclose(far, flow.own_motion(depth, K, R, np.zeros(3)), atol=1e-12)


def test_the_clusters_distance_is_the_weighted_mahalanobis_one():
    rng = np.random.default_rng(6)
    features = rng.normal(size=(200, 7)) @ rng.normal(size=(7, 7))
    white = clusters.whitened(features)
    S = np.cov(features, rowvar=False)
    S += np.diag(1e-3 * np.diag(S) + 1e-9)
    half = np.diag(np.sqrt(clusters.WEIGHTS))
    dx = features[3] - features[8]
    assert np.sum((white[3] - white[8]) ** 2) == pytest.approx(dx @ half @ np.linalg.inv(S) @ half @ dx)


def test_clusters_that_stand_apart_are_counted():
    rng = np.random.default_rng(7)
    points = np.concatenate([rng.normal(c, 0.1, (60, 3)) for c in (0, 3, 7)])
    labels = clusters.segmented(points, 6, None)
    assert len(np.unique(labels)) == 3
    assert len(np.unique(clusters.segmented(rng.normal(size=(200, 3)), 6, None))) <= 2
