"""Motion models, interacting models, odometry, flow, clusters: the oracles of the papers' equations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drives import stacked
from visfuse_cli.maths import course, gaussian, imm, motion, odometry
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


def linear(F, Q):
    return lambda x: (gaussian.times(F, x), F, Q)


def some_belief(rng: np.random.Generator, *shape: int) -> Gaussian:
    n = shape[-1]
    A = rng.normal(size=(*shape, n))
    return Gaussian(rng.normal(size=shape), A @ np.swapaxes(A, -1, -2) + np.eye(n))


def test_copies_of_one_model_are_that_models_kalman_filter_and_smoother():
    rng = np.random.default_rng(2)
    F, Q, H, R = (
        motion.constant_velocity(0.1, 2),
        motion.constant_velocity_noise(0.1, 0.5, 2),
        np.eye(2, 4),
        0.04 * np.eye(2),
    )
    single = Gaussian(np.zeros(4), np.eye(4))
    bank = imm.Bank(imm.start(single, 3).beliefs, np.log(np.array([0.2, 0.5, 0.3])))
    log_p = imm.transition(3, 0.9)
    steps, filtered, predicted = [], [], []
    for _ in range(20):
        z = rng.normal(size=2)
        predicted.append(gaussian.predict(single, F, Q))
        single, _ = gaussian.update(predicted[-1], z - predicted[-1].mean[:2], H, R)
        filtered.append(single)
        step = imm.predict(bank, log_p, linear(np.tile(F, (3, 1, 1)), Q))
        step, _ = imm.update(step, z - step.predicted.mean[:, :2], H, R)
        steps.append(step)
        bank = step.filtered
        assert np.exp(bank.log_mu).sum() == pytest.approx(1)
    both = imm.combined(bank)
    np.testing.assert_allclose(both.mean, single.mean, atol=1e-10)
    np.testing.assert_allclose(both.cov, single.cov, atol=1e-10)
    wanted = rauch_tung_striebel(stacked(filtered), stacked(predicted), np.tile(F, (20, 1, 1)))
    found = stacked([imm.combined(bank) for bank in imm.smooth(steps, log_p)])
    np.testing.assert_allclose(found.mean, wanted.mean, atol=1e-9)
    np.testing.assert_allclose(found.cov, wanted.cov, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000))
def test_mixing_keeps_the_moments_of_all_models_together(seed):
    rng = np.random.default_rng(seed)
    bank = imm.Bank(some_belief(rng, 2, 3, 5), np.log(rng.dirichlet(np.ones(3), 2)))
    log_p = np.log(rng.dirichlet(np.ones(3), 3))
    mixed, ahead = imm.mix(bank, log_p)
    before, after = imm.combined(bank), imm.combined(imm.Bank(mixed, ahead))
    np.testing.assert_allclose(after.mean, before.mean, atol=1e-10)
    np.testing.assert_allclose(after.cov, before.cov, atol=1e-9)
    np.testing.assert_allclose(np.exp(ahead).sum(axis=-1), 1, atol=1e-12)
    assert np.linalg.eigvalsh(mixed.cov).min() > 0


def test_models_either_side_of_the_half_turn_meet_there():
    bank = imm.Bank(Gaussian(np.array([[0.0, 3.0], [2.0, -3.0]]), np.zeros((2, 2, 2))), np.log([0.5, 0.5]))
    apart = np.pi - 3
    for angles, mean, deviation in (((1,), np.pi, apart), ((), 0.0, -3.0), ((1,), np.pi, apart)):
        both = imm.combined(bank, angles)
        np.testing.assert_allclose(np.abs(both.mean), [1.0, mean], atol=1e-12)
        np.testing.assert_allclose(both.cov, [[1.0, deviation], [deviation, deviation**2]], atol=1e-12)
        mixed, _ = imm.mix(bank, np.log(np.full((2, 2), 0.5)), angles)
        np.testing.assert_allclose(np.abs(mixed.mean), np.abs([both.mean] * 2), atol=1e-12)
        np.testing.assert_allclose(mixed.cov, [both.cov] * 2, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.permutations([0, 1, 2]), st.floats(0.01, 100))
def test_an_instant_does_not_depend_on_the_models_order_nor_on_units(seed, order, unit):
    rng = np.random.default_rng(seed)
    log_p, order = imm.transition(3, 0.9), list(order)
    F = np.eye(4) + 0.1 * rng.normal(size=(3, 4, 4))
    Q, H, R = some_belief(rng, 3, 4).cov, rng.normal(size=(2, 4)), np.diag([0.5, 0.2])
    z = rng.normal(size=2)

    def after(beliefs, log_mu, scale, rows):
        U = scale * np.eye(4)
        bank = imm.Bank(Gaussian(scale * beliefs.mean[rows], scale**2 * beliefs.cov[rows]), log_mu[rows])
        step = imm.predict(bank, log_p, linear(F[rows], U @ Q[rows] @ U))
        step, _ = imm.update(step, scale * z - gaussian.times(H, step.predicted.mean), H, scale**2 * R)
        return imm.combined(step.filtered), step.filtered.log_mu

    beliefs, log_mu = some_belief(rng, 3, 4), np.log(rng.dirichlet(np.ones(3)))
    plain, plain_mu = after(beliefs, log_mu, 1.0, [0, 1, 2])
    other, other_mu = after(beliefs, log_mu, unit, order)
    np.testing.assert_allclose(other.mean, unit * plain.mean, rtol=1e-7, atol=1e-9 * unit)
    np.testing.assert_allclose(other.cov, unit**2 * plain.cov, rtol=1e-6, atol=1e-9 * unit**2)
    np.testing.assert_allclose(other_mu, plain_mu[order], atol=1e-8)


def test_models_change_alike_at_every_frame_rate():
    whole, half = (np.exp(imm.changes(4, dt, 3.0)) for dt in (0.2, 0.1))
    np.testing.assert_allclose(half @ half, whole, atol=1e-12)
    np.testing.assert_allclose(np.exp(imm.changes(4, 1e-4, 3.0))[0, 0], 1 - 1e-4 / 3.0, atol=1e-8)
    np.testing.assert_array_equal(np.exp(imm.changes(4, 0.0, 3.0)), np.eye(4))


def test_a_short_model_in_the_common_state_is_that_model():
    rng = np.random.default_rng(9)
    spare = np.repeat([1.0, 4.0, 9.0], 2)
    small = motion.constant_velocity(0.1, 2), motion.constant_velocity_noise(0.1, 0.3, 2)
    F, Q = imm.embedded(*small, range(4), spare)
    wide = some_belief(rng, 6)
    alone = Gaussian(wide.mean[:4], wide.cov[:4, :4])
    H, R, z = np.eye(2, 6), 0.1 * np.eye(2), rng.normal(size=2)
    wide = gaussian.predict(wide, F, Q)
    wide, first = gaussian.update(wide, z - wide.mean[:2], H, R)
    alone = gaussian.predict(alone, *small)
    alone, second = gaussian.update(alone, z - alone.mean[:2], H[:, :4], R)
    np.testing.assert_allclose(wide.mean, [*alone.mean, 0, 0], atol=1e-12)
    np.testing.assert_allclose(wide.cov[:4, :4], alone.cov, atol=1e-12)
    np.testing.assert_allclose(wide.cov[4:, 4:], np.diag(spare[4:]), atol=1e-12)
    assert first.log_likelihood == pytest.approx(second.log_likelihood)


def test_the_periodic_model_swings_about_its_own_centre():
    models = Models(FilterSettings(kind="periodic"))
    bank = models.start(Gaussian(np.array([7.0, 0, 0]), np.eye(3)), Gaussian(np.zeros(3), np.eye(3)))
    bank.beliefs.mean[0, 9] = 2.0  # 2 m to the right of its centre
    ahead = imm.combined(models.predict(bank, np.pi).filtered)  # half a swing at 1 rad/s
    np.testing.assert_allclose(ahead.mean[[0, 9]], [3.0, -2.0], atol=1e-9)


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
    drive = odometry.Drive(t, np.full(41, -w * b / 2), np.full(41, w * b / 2), b, (0, 0))
    poses = drive.camera(t, 0.2, np.array([0.3, -0.5, 0.1]))
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
    np.testing.assert_allclose(found[50, 13], seen[:2] / seen[2] * 220 + [40, 30] - [13, 50], atol=1e-4)
    far = flow.own_motion(np.full((60, 80), np.inf), K, R, t)
    np.testing.assert_allclose(far, flow.own_motion(depth, K, R, np.zeros(3)), atol=1e-5)


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
