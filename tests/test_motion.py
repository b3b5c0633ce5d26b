"""Motion models against geometry, central differences and the splitting of a step."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visfuse_cli.maths import motion
from visfuse_cli.maths.angles import wrap_at

WHEELBASE = 2.5
STATES = st.tuples(
    st.floats(-50, 50), st.floats(-50, 50), st.floats(-15, 30), st.floats(-3, 3), st.floats(-0.69, 0.69)
).map(np.array)


def axles(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    half = WHEELBASE / 2 * np.stack([np.cos(x[..., 3]), np.sin(x[..., 3])], axis=-1)
    return x[..., :2] - half, x[..., :2] + half


@settings(max_examples=50, deadline=None)
@given(STATES)
def test_wheels_roll_without_slipping(x: np.ndarray):
    h = 1e-4
    before, after = axles(motion.bicycle(x, -h, WHEELBASE)[0]), axles(motion.bicycle(x, h, WHEELBASE)[0])
    rear, front = ((b - a) / (2 * h) for a, b in zip(before, after, strict=True))
    theta, phi = x[3], x[4]
    np.testing.assert_allclose(rear, x[2] * np.array([np.cos(theta), np.sin(theta)]), atol=1e-5)
    along = x[2] / np.cos(phi) * np.array([np.cos(theta + phi), np.sin(theta + phi)])
    np.testing.assert_allclose(front, along, atol=1e-5)


@settings(max_examples=50, deadline=None)
@given(STATES)
def test_velocity_of_the_centre_is_the_papers(x: np.ndarray):
    velocity, J = motion.bicycle_velocity(x)
    c = np.cos(x[4])
    speed, direction = x[2] * np.sqrt(1 + 3 * c**2) / (2 * c), x[3] + np.arctan(np.tan(x[4]) / 2)
    np.testing.assert_allclose(velocity, speed * np.array([np.cos(direction), np.sin(direction)]), atol=1e-9)
    h = 1e-4
    moved = motion.bicycle(x, h, WHEELBASE)[0] - motion.bicycle(x, -h, WHEELBASE)[0]
    np.testing.assert_allclose(velocity, moved[:2] / (2 * h), atol=1e-5)
    np.testing.assert_allclose(J, differences(lambda s: motion.bicycle_velocity(s)[0], x), atol=1e-6)


def differences(f, x: np.ndarray, angles: tuple[int, ...] = ()) -> np.ndarray:
    h = 1e-6
    columns = [wrap_at(f(x + h * e) - f(x - h * e), angles) / (2 * h) for e in np.eye(len(x))]
    return np.stack(columns, axis=-1)


@settings(max_examples=80, deadline=None)
@given(STATES, st.floats(0.001, 0.5), st.sampled_from([None, 0.0, 1e-7, -1e-4]))
def test_jacobian_equals_central_differences(x: np.ndarray, dt: float, phi: float | None):
    x = x if phi is None else np.append(x[:4], phi)
    F = motion.bicycle(x, dt, WHEELBASE)[1]
    np.testing.assert_allclose(F, differences(lambda s: motion.bicycle(s, dt, WHEELBASE)[0], x, (3,)), atol=1e-6)


def test_two_halves_of_a_step_are_the_step():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(20, 5)) * [10, 10, 8, 1.5, 0.25]
    dt = rng.uniform(0.02, 0.3, size=20)
    whole, F = motion.bicycle(x, dt, WHEELBASE)
    middle, F1 = motion.bicycle(x, 0.3 * dt, WHEELBASE)
    end, F2 = motion.bicycle(middle, 0.7 * dt, WHEELBASE)
    np.testing.assert_allclose(end, whole, atol=1e-12)
    np.testing.assert_allclose(F2 @ F1, F, atol=1e-12)


def test_a_full_circle_returns_to_its_start():
    x = np.array([3.0, -2, 5, 1, 0.4])
    period = 2 * np.pi * WHEELBASE / (5 * np.tan(0.4))
    np.testing.assert_allclose(motion.bicycle(x, period, WHEELBASE)[0], x, atol=1e-9)


def test_reversing_retraces_the_way():
    x = np.array([3.0, -2, 5, 1, 0.4])
    there = motion.bicycle(x, 1.5, WHEELBASE)[0]
    back = motion.bicycle(there * [1, 1, -1, 1, 1], 1.5, WHEELBASE)[0]
    np.testing.assert_allclose(back, x * [1, 1, -1, 1, 1], atol=1e-9)


def test_steering_beyond_the_limit_is_cut_and_its_jacobian_stays_open():
    x, F = motion.bicycle(np.array([0, 0, 5, 0, 1.4]), 0.1, WHEELBASE)
    assert x[4] == motion.STEERING_LIMIT
    assert F[4, 4] == 1
    assert np.isfinite(F).all()


def test_splitting_leaves_the_bicycles_noise_unchanged():
    rng = np.random.default_rng(2)
    x = rng.normal(size=(30, 5)) * [10, 10, 8, 1.5, 0.25]
    dt = 0.1
    whole = motion.bicycle_noise(x, dt, WHEELBASE, 1.5, 0.3)
    middle = motion.bicycle(x, dt / 2, WHEELBASE)[0]
    F = motion.bicycle(middle, dt / 2, WHEELBASE)[1]
    halves = F @ motion.bicycle_noise(x, dt / 2, WHEELBASE, 1.5, 0.3) @ F.swapaxes(-1, -2)
    halves += motion.bicycle_noise(middle, dt / 2, WHEELBASE, 1.5, 0.3)
    scale = np.sqrt(np.diagonal(whole, axis1=1, axis2=2))
    np.testing.assert_allclose((halves - whole) / (scale[:, :, None] * scale[:, None]), 0, atol=1e-4)
    assert np.linalg.eigvalsh(whole).min() > -1e-15


def test_noise_on_a_straight_path_has_the_closed_form():
    dt, v, a2, b2 = 0.2, 10.0, 1.5**2, 0.3**2
    Q = motion.bicycle_noise(np.array([0.0, 0, v, 0, 0]), dt, WHEELBASE, 1.5, 0.3)
    assert Q[0, 0] == pytest.approx(a2 * dt**3 / 3)
    assert Q[0, 2] == pytest.approx(a2 * dt**2 / 2)
    assert Q[2, 2] == pytest.approx(a2 * dt)
    assert Q[4, 4] == pytest.approx(b2 * dt)
    assert Q[3, 3] == pytest.approx(b2 * (v / WHEELBASE) ** 2 * dt**3 / 3)
    # y moves at once by half the steering, and later by the heading: v u / 2 + v^2 u^2 / (2 l) after u seconds.
    first, second = v / 2, v**2 / (2 * WHEELBASE)
    assert Q[1, 1] == pytest.approx(b2 * (first**2 * dt**3 / 3 + first * second * dt**4 / 2 + second**2 * dt**5 / 5))


def test_noise_matches_simulated_drivers():
    rng = np.random.default_rng(3)
    runs, pieces, dt = 8000, 20, 0.2
    start = np.array([0.0, 0, 8, 0.5, 0.2])
    x = np.repeat(start[None], runs, axis=0)
    for _ in range(pieces):
        x = motion.bicycle(x, dt / pieces / 2, WHEELBASE)[0]
        x[:, [2, 4]] += rng.normal(size=(runs, 2)) * [1.0, 0.1] * np.sqrt(dt / pieces)
        x = motion.bicycle(x, dt / pieces / 2, WHEELBASE)[0]
    expected = motion.bicycle_noise(start, dt, WHEELBASE, 1.0, 0.1)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.cov(x.T) / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.06)


@given(st.floats(1e-3, 2), st.floats(0.05, 0.95), st.integers(1, 3))
def test_splitting_leaves_constant_velocity_unchanged(dt: float, part: float, dims: int):
    F = motion.constant_velocity(dt, dims)
    F1, F2 = motion.constant_velocity(part * dt, dims), motion.constant_velocity((1 - part) * dt, dims)
    np.testing.assert_allclose(F2 @ F1, F, atol=1e-12)
    Q1 = motion.constant_velocity_noise(part * dt, 0.3, dims)
    Q2 = motion.constant_velocity_noise((1 - part) * dt, 0.3, dims)
    np.testing.assert_allclose(F2 @ Q1 @ F2.T + Q2, motion.constant_velocity_noise(dt, 0.3, dims), atol=1e-12)


def test_constant_velocity_orders_positions_before_velocities():
    F = motion.constant_velocity(np.array([0.5, 2.0]), 2)
    np.testing.assert_allclose(F[1] @ [1, 2, 10, 20], [21, 42, 10, 20])
    assert F.shape == (2, 4, 4)


def test_two_places_start_a_track_as_the_paper_has_it():
    R, T = np.array([[0.04, 0.01], [0.01, 0.09]]), 0.2
    places = np.array([[1.0, 2.0], [1.3, 1.8]])
    place, velocity = motion.line_start(np.array([-T, 0.0]), places, R)
    np.testing.assert_allclose(place.mean, places[1], atol=1e-12)
    np.testing.assert_allclose(velocity.mean, (places[1] - places[0]) / T, atol=1e-12)
    np.testing.assert_allclose(place.cov, R, atol=1e-12)
    np.testing.assert_allclose(velocity.cov, 2 * R / T**2, atol=1e-12)


def test_a_start_from_many_places_is_as_wrong_as_it_says():
    rng, R = np.random.default_rng(0), np.diag([0.04, 0.09])
    t = np.array([0.0, 0.1, 0.25, 0.3])
    chi = np.zeros(2)
    for _ in range(500):
        places = np.array([5.0, -1.0]) + t[:, None] * np.array([2.0, 1.0]) + rng.normal(size=(4, 2)) @ np.sqrt(R)
        for k, (belief, truth) in enumerate(zip(motion.line_start(t, places, R), ([5, -1], [2, 1]), strict=True)):
            off = belief.mean - truth
            chi[k] += off @ np.linalg.solve(belief.cov, off) / 500
    np.testing.assert_allclose(chi, 2.0, rtol=0.15)
