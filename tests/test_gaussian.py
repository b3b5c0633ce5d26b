"""The Gaussian belief against one joint Gaussian, and its properties under random input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, multivariate_normal

from visfuse_cli.maths import gaussian, motion
from visfuse_cli.maths.angles import wrap, wrap_at
from visfuse_cli.records import Gaussian

H = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0]])


def covariance(rng: np.random.Generator, *shape: int) -> np.ndarray:
    root = rng.normal(size=(*shape, shape[-1] + 2))
    return root @ root.swapaxes(-1, -2)


def test_update_equals_conditioning_of_the_joint_gaussian():
    rng = np.random.default_rng(1)
    P, R, m, z = covariance(rng, 4), covariance(rng, 2), rng.normal(size=4), rng.normal(size=2)
    posterior, innovation = gaussian.update(Gaussian(m, P), z - H @ m, H, R)
    S = H @ P @ H.T + R
    np.testing.assert_allclose(posterior.mean, m + P @ H.T @ np.linalg.inv(S) @ (z - H @ m), rtol=1e-12)
    np.testing.assert_allclose(posterior.cov, P - P @ H.T @ np.linalg.inv(S) @ H @ P, rtol=1e-10, atol=1e-12)
    assert innovation.log_likelihood == pytest.approx(multivariate_normal(H @ m, S).logpdf(z), rel=1e-12)
    assert innovation.nis == pytest.approx((z - H @ m) @ np.linalg.inv(S) @ (z - H @ m), rel=1e-12)


def test_a_measurement_of_all_but_unknown_states_leaves_its_own_noise():
    # 1e14 times less than was there before: what is left of the prior by subtraction alone is rounding.
    rng = np.random.default_rng(9)
    for _ in range(20):
        R = 1e-2 * covariance(rng, 2)
        after, _ = gaussian.update(Gaussian(np.zeros(4), 1e12 * np.eye(4)), rng.normal(size=2), H, R)
        np.testing.assert_allclose(after.cov[:2, :2], R, rtol=1e-6)
        assert np.linalg.eigvalsh(after.cov).min() > 0


def test_a_direction_all_but_unknown_leaves_the_others_as_they_are():
    rng = np.random.default_rng(10)
    R = 0.04 * np.eye(2)
    for _ in range(20):
        axes, _ = np.linalg.qr(rng.normal(size=(4, 4)))  # the vague one lies across all that is measured
        variances = np.array([1e12, 1, 1, 1])
        after, _ = gaussian.update(Gaussian(np.zeros(4), axes * variances @ axes.T), rng.normal(size=2), H, R)
        information = axes / variances @ axes.T + H.T @ np.linalg.inv(R) @ H
        np.testing.assert_allclose(after.cov @ information, np.eye(4), atol=0.02)


def test_filter_over_many_steps_equals_one_joint_gaussian():
    rng = np.random.default_rng(2)
    steps, q = 6, 0.7
    P0, R, m0 = covariance(rng, 4), covariance(rng, 2), rng.normal(size=4)
    F, Q = motion.constant_velocity(0.3), motion.constant_velocity_noise(0.3, q)
    z = rng.normal(size=(steps, 2))
    belief = Gaussian(m0, P0)
    for row in z:
        belief = gaussian.predict(belief, F, Q)
        belief, _ = gaussian.update(belief, row - H @ belief.mean, H, R)

    # The last state and all measurements as linear functions of (x0, w1 .. wN, e1 .. eN).
    state = np.hstack([np.eye(4), np.zeros((4, 4 * steps + 2 * steps))])
    rows = []
    for k in range(steps):
        state = F @ state
        state[:, 4 + 4 * k : 8 + 4 * k] += np.eye(4)
        row = H @ state
        row[:, 4 + 4 * steps + 2 * k : 6 + 4 * steps + 2 * k] += np.eye(2)
        rows.append(row)
    A = np.vstack(rows)
    joint = np.zeros((A.shape[1],) * 2)
    joint[:4, :4] = P0
    for k in range(steps):
        joint[4 + 4 * k : 8 + 4 * k, 4 + 4 * k : 8 + 4 * k] = Q
        joint[4 + 4 * steps + 2 * k :, 4 + 4 * steps + 2 * k :][:2, :2] = R
    gain = state @ joint @ A.T @ np.linalg.inv(A @ joint @ A.T)
    mean = state[:, :4] @ m0 + gain @ (z.ravel() - A[:, :4] @ m0)
    np.testing.assert_allclose(belief.mean, mean, rtol=1e-9)
    np.testing.assert_allclose(belief.cov, state @ joint @ state.T - gain @ A @ joint @ state.T, atol=1e-9)


def test_a_batch_equals_its_members():
    rng = np.random.default_rng(3)
    belief = Gaussian(rng.normal(size=(2, 3, 4)), covariance(rng, 2, 3, 4))
    residual, R = rng.normal(size=(2, 3, 2)), covariance(rng, 2)
    batch, innovation = gaussian.update(belief, residual, H, R)
    for i in np.ndindex(2, 3):
        one, single = gaussian.update(Gaussian(belief.mean[i], belief.cov[i]), residual[i], H, R)
        np.testing.assert_allclose(batch.mean[i], one.mean, rtol=1e-12)
        np.testing.assert_allclose(batch.cov[i], one.cov, rtol=1e-12)
        assert innovation.log_likelihood[i] == pytest.approx(single.log_likelihood)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.floats(-8, 3), st.floats(-6, 6))
def test_covariances_stay_symmetric_and_positive_definite(seed: int, noise: float, prior: float):
    rng = np.random.default_rng(seed)
    belief = Gaussian(rng.normal(size=4), 10.0**prior * covariance(rng, 4))
    R = 10.0**noise * covariance(rng, 2)
    for _ in range(5):
        belief = gaussian.predict(belief, motion.constant_velocity(0.04), motion.constant_velocity_noise(0.04, 0.1))
        belief, _ = gaussian.update(belief, rng.normal(size=2), H, R)
        assert np.array_equal(belief.cov, belief.cov.T)
        assert np.linalg.eigvalsh(belief.cov).min() > 0


def test_moments_of_a_mixture_match_its_samples():
    rng = np.random.default_rng(4)
    means, covs, weights = rng.normal(size=(3, 2)) * 3, covariance(rng, 3, 2), np.array([0.2, 0.5, 0.3])
    matched = gaussian.moment_match(means, covs, np.log(weights) - 1e4)
    which = rng.choice(3, 200_000, p=weights)
    samples = means[which] + np.einsum("kij,kj->ki", np.linalg.cholesky(covs)[which], rng.normal(size=(200_000, 2)))
    np.testing.assert_allclose(matched.mean, samples.mean(0), atol=0.05)
    np.testing.assert_allclose(matched.cov, np.cov(samples.T), rtol=0.03, atol=0.1)


def test_moment_matching_averages_angles_on_the_circle():
    means = np.array([[1.0, np.pi - 0.1], [3.0, -np.pi + 0.1]])
    matched = gaussian.moment_match(means, np.zeros((2, 2, 2)), np.log([0.5, 0.5]), angles=(1,))
    np.testing.assert_allclose(matched.mean, [2.0, np.pi], atol=1e-12)
    np.testing.assert_allclose(matched.cov, [[1.0, 0.1], [0.1, 0.01]], atol=1e-12)


def test_one_component_is_matched_by_itself():
    rng = np.random.default_rng(5)
    mean, cov = rng.normal(size=(1, 3)), covariance(rng, 1, 3)
    matched = gaussian.moment_match(mean, cov, np.array([7.0]))
    np.testing.assert_allclose(matched.mean, mean[0])
    np.testing.assert_allclose(matched.cov, cov[0])


def test_errors_and_innovations_are_consistent_on_matched_simulations():
    rng = np.random.default_rng(6)
    runs, steps, dt, q = 200, 60, 0.1, 0.5
    F, Q = motion.constant_velocity(dt), motion.constant_velocity_noise(dt, q)
    P0, R = np.diag([1.0, 1, 4, 4]), 0.09 * np.eye(2)
    truth = rng.normal(size=(runs, 4)) * np.sqrt(np.diag(P0))
    belief = Gaussian(np.zeros((runs, 4)), np.broadcast_to(P0, (runs, 4, 4)))
    nis = []
    for _ in range(steps):
        truth = truth @ F.T + rng.normal(size=(runs, 4)) @ np.linalg.cholesky(Q).T
        belief = gaussian.predict(belief, F, Q)
        z = truth[:, :2] + 0.3 * rng.normal(size=(runs, 2))
        belief, innovation = gaussian.update(belief, z - belief.mean[:, :2], H, R)
        nis.append(innovation.nis)
    nees = gaussian.mahalanobis(belief.mean - truth, belief.cov)
    low, high = chi2.ppf([0.001, 0.999], 4 * runs) / runs
    assert low < nees.mean() < high
    low, high = chi2.ppf([0.001, 0.999], 2 * runs * steps) / (runs * steps)
    assert low < np.mean(nis) < high


def test_a_covariance_that_is_not_positive_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        gaussian.log_density(np.zeros(2), np.diag([1.0, -1.0]))


@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_lie_in_one_turn_and_point_the_same_way(angle: float):
    wrapped = float(wrap(angle))
    assert -np.pi < wrapped <= np.pi
    assert np.cos(wrapped - angle) == pytest.approx(1, abs=1e-9)


def test_both_half_turns_have_one_name():
    np.testing.assert_array_equal(wrap([np.pi, -np.pi]), [np.pi, np.pi])


def test_wrapping_some_components_leaves_the_input_alone():
    vector = np.array([[7.0, 7.0]])
    np.testing.assert_allclose(wrap_at(vector, (1,)), [[7.0, 7.0 - 2 * np.pi]])
    assert vector[0, 1] == 7.0
