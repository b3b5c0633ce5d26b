"""Lou's fading factor against the plain filter, and noise adaptation that stays positive definite."""

import numpy as np
import pytest

from visfuse_cli.maths import fading, gaussian, motion
from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.records import Gaussian

H = motion.BICYCLE_MEASUREMENT
WHEELBASE = 2.5
R = np.diag([0.05, 0.05, 0.02]) ** 2
DT = 0.04


def drive(acceleration: np.ndarray, steering_rate: np.ndarray, speed: float) -> np.ndarray:
    """True states (T, 5) of one car, accelerated and steered as told at each frame."""
    x = np.array([0, 0, speed, 0.3, 0.0])
    states = [x]
    for a, b in zip(acceleration, steering_rate, strict=True):
        for _ in range(10):
            x = motion.bicycle(x + np.array([0, 0, a, 0, b]) * DT / 10, DT / 10, WHEELBASE)[0]
        states.append(x)
    return np.array(states)


def track(path: np.ndarray, limit: float, runs: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of estimate and prediction (T, runs, 5) and the factors (T, runs) over seeded measurements of a path."""
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(len(path), runs, 3)) @ np.sqrt(R)
    P0 = np.diag([0.1, 0.1, 0.5, 0.05, 0.05]) ** 2
    belief = Gaussian(path[0] + rng.normal(size=(runs, 5)) @ np.sqrt(P0), np.broadcast_to(P0, (runs, 5, 5)))
    state, errors, ahead, factors = None, [], [], []
    for truth, e in zip(path[1:], noise[1:], strict=True):
        mean, F = motion.bicycle(belief.mean, DT, WHEELBASE)
        Q = motion.bicycle_noise(belief.mean, DT, WHEELBASE, 0.1, 0.01)
        predicted = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        state = state or fading.start(predicted, H, R)
        residual = wrap_at(truth[[0, 1, 3]] + e - mean[:, [0, 1, 3]], (2,))
        step = fading.update(predicted, Q, residual, H, R, state, limit=limit)
        belief, state = step.posterior, step.state
        errors.append(wrap_at(belief.mean - truth, (3,)))
        ahead.append(wrap_at(mean - truth, (3,)))
        factors.append(step.factor)
    return np.array(errors)[20:], np.array(ahead)[20:], np.array(factors)[20:]


def during(t: np.ndarray, start: float, end: float, value: float) -> np.ndarray:
    return np.where((t > start) & (t < end), value, 0.0)


@pytest.fixture(scope="module")
def t() -> np.ndarray:
    return np.arange(300) * DT


def test_on_smooth_motion_the_filter_is_the_ekf_within_five_per_cent(t: np.ndarray):
    path = drive(np.zeros(300), during(t, 2, 4, 0.02), 8.0)
    plain, faded = (np.sqrt((track(path, limit)[0] ** 2).mean(axis=(0, 1))) for limit in (1.0, fading.LIMIT))
    np.testing.assert_array_less(faded[:4], 1.05 * plain[:4])


def test_in_a_hard_manoeuvre_its_peak_error_is_well_below_the_ekfs(t: np.ndarray):
    braking = during(t, 4, 5, -5) + during(t, 6, 8, 3)
    steering = during(t, 6, 7, 0.55) + during(t, 8, 9, -0.55)
    path = drive(braking, steering, 6.0)
    (_, plain, _), (_, faded, factor) = track(path, 1.0), track(path, fading.LIMIT)
    peak = np.abs(faded).max(axis=0).mean(axis=0) / np.abs(plain).max(axis=0).mean(axis=0)
    assert peak[[0, 1, 3]].max() < 0.6
    assert factor.max() > 5


def test_limit_one_is_the_extended_kalman_filter_to_the_byte():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(5, 5))
    predicted, residual = Gaussian(rng.normal(size=5), root @ root.T + np.eye(5)), rng.normal(size=3)
    step = fading.update(predicted, 0.1 * np.eye(5), residual, H, R, fading.start(predicted, H, R), limit=1.0)
    plain, _ = gaussian.update(predicted, residual, H, R)
    np.testing.assert_array_equal(step.posterior.mean, plain.mean)
    np.testing.assert_array_equal(step.posterior.cov, plain.cov)
    np.testing.assert_array_equal(step.prior.cov, predicted.cov)


def test_the_factor_is_the_ratio_of_weighted_traces_within_its_limits():
    spread, Q = np.diag([1.0, 2, 3, 4, 5]), np.diag([0.1, 0.2, 0.3, 0.4, 0.5])
    noise = np.diag([0.01, 0.02, 0.03])
    U = np.diag([5.0, 6.0, 30.0])
    numerator = 0.1 * (5 - 0.1 - 0.025) + 0.1 * (6 - 0.2 - 0.05) + 2.8 * (30 - 0.4 - 0.075)
    expected = numerator / (0.1 * 1 + 0.1 * 2 + 2.8 * 4)
    assert fading.fading_factor(U, spread, Q, H, noise) == pytest.approx(expected)
    assert fading.fading_factor(0 * U, spread, Q, H, noise) == 1
    assert fading.fading_factor(1e3 * U, spread, Q, H, noise) == fading.LIMIT
    assert fading.fading_factor(U, 0 * spread, Q, H, noise) == fading.LIMIT


def test_the_faded_prior_is_lambda_times_the_past_plus_the_noise():
    root = np.random.default_rng(3).normal(size=(5, 5))
    spread, Q = root @ root.T, 0.1 * np.eye(5)
    predicted = Gaussian(np.zeros(5), spread + Q)
    step = fading.update(predicted, Q, np.array([0.5, 0, 9.0]), H, R, fading.start(predicted, H, R))
    assert 1 < step.factor <= fading.LIMIT
    np.testing.assert_allclose(step.prior.cov, step.factor * spread + Q, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("beta", [0.8, 0.98, 1.0])
def test_adapted_noise_keeps_positive_eigenvalues_over_ten_thousand_steps(beta: float):
    rng = np.random.default_rng(4)
    F, Hc = motion.constant_velocity(0.1, 1), np.array([[1.0, 0]])
    floors = np.array([1e-8, 1e-8]), np.array([1e-6])
    noise = fading.AdaptiveNoise(np.broadcast_to(0.1 * np.eye(2), (4, 2, 2)), np.broadcast_to(np.eye(1), (4, 1, 1)))
    truth, belief = np.zeros((4, 1)), Gaussian(np.zeros((4, 2)), np.broadcast_to(np.eye(2), (4, 2, 2)))
    least_Q = least_R = np.inf
    for _ in range(10_000):
        truth = truth + 0.1 * rng.normal(size=truth.shape)
        predicted = gaussian.predict(belief, F, noise.Q)
        z = truth + 0.2 * rng.normal(size=truth.shape)
        residual = z - predicted.mean[:, :1]
        belief, _ = gaussian.update(predicted, residual, Hc, noise.R)
        after, correction = z - belief.mean[:, :1], belief.mean - predicted.mean
        noise = fading.adapt_noise(noise, belief, after, correction, Hc, floors, beta)
        least_Q = min(least_Q, np.linalg.eigvalsh(noise.Q).min())
        least_R = min(least_R, noise.R.min())
    assert least_Q >= 0.999e-8
    assert least_R >= 0.999e-6
    assert np.isfinite(belief.mean).all()


def test_a_vanishing_factor_of_one_averages_all_samples_alike():
    noise = fading.AdaptiveNoise(np.eye(2), np.eye(1), count=1)
    belief, Hc = Gaussian(np.zeros(2), np.zeros((2, 2))), np.array([[1.0, 0]])
    floors = np.full(2, 1e-9), np.full(1, 1e-9)
    samples = [2.0, 3.0, 4.0]
    for e in samples:
        noise = fading.adapt_noise(noise, belief, np.array([e]), np.zeros(2), Hc, floors, beta=1.0)
    assert noise.R[0, 0] == pytest.approx((1 + sum(e**2 for e in samples)) / 4)
    assert noise.Q[0, 0] == pytest.approx(1 / 4)
    near = fading.adapt_noise(fading.AdaptiveNoise(np.eye(2), np.eye(1)), belief, np.ones(1), np.ones(2), Hc, floors, 1)
    limit = fading.adapt_noise(
        fading.AdaptiveNoise(np.eye(2), np.eye(1)), belief, np.ones(1), np.ones(2), Hc, floors, 1 - 1e-9
    )
    np.testing.assert_allclose(near.Q, limit.Q, atol=1e-6)


def test_noise_floors_hold_in_every_direction():
    floors = np.array([0.5, 0.02]), np.array([0.1])
    noise = fading.AdaptiveNoise(np.array([[1.0, 0.999], [0.999, 1.0]]), np.array([[1e-9]]))
    belief, Hc = Gaussian(np.zeros(2), np.zeros((2, 2))), np.array([[1.0, 0]])
    adapted = fading.adapt_noise(noise, belief, np.zeros(1), np.ones(2), Hc, floors)
    assert np.linalg.eigvalsh(adapted.Q - np.diag(floors[0])).min() > -1e-12
    assert adapted.R[0, 0] == pytest.approx(0.1)
