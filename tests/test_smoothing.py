"""The smoother against one joint Gaussian over the whole track, linear and extended."""

import numpy as np
from scipy.stats import chi2

from tests.drives import bicycle_run, stacked
from visfuse_cli.maths import gaussian, motion, smoothing
from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.records import Gaussian

H = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0]])


def linear_track(rng: np.random.Generator, dts: np.ndarray, measured: np.ndarray, q: float, R: np.ndarray):
    """Filter a random track; the prior of the first state is N(0, P0)."""
    P0 = np.diag([2.0, 2, 5, 5])
    F, Q = motion.constant_velocity(dts), motion.constant_velocity_noise(dts, q)
    z = rng.normal(size=(len(dts), 2)) * 2
    filtered, predicted = [], []
    for k in range(len(dts)):
        prior = Gaussian(np.zeros(4), P0) if k == 0 else gaussian.predict(filtered[-1], F[k], Q[k])
        predicted.append(prior)
        filtered.append(gaussian.update(prior, z[k] - H @ prior.mean, H, R)[0] if measured[k] else prior)
    return stacked(filtered), stacked(predicted), F, Q, P0, z


def test_smoother_and_its_correlations_equal_the_joint_gaussian():
    rng = np.random.default_rng(1)
    dts = rng.uniform(0.02, 0.3, size=7)
    measured = np.array([True, True, False, True, False, False, True])
    R = np.array([[0.3, 0.1], [0.1, 0.2]])
    filtered, predicted, F, Q, P0, z = linear_track(rng, dts, measured, 0.8, R)
    smoothed = smoothing.rauch_tung_striebel(filtered, predicted, F)

    # Information form of all states at once.
    T, n = 7, 4
    information, vector = np.zeros((T * n, T * n)), np.zeros(T * n)
    information[:n, :n] += np.linalg.inv(P0)
    for k in range(T):
        own = slice(n * k, n * k + n)
        if k:
            step = np.zeros((n, T * n))
            step[:, n * k - n : n * k], step[:, own] = -F[k], np.eye(n)
            information += step.T @ np.linalg.inv(Q[k]) @ step
        if measured[k]:
            information[own, own] += H.T @ np.linalg.inv(R) @ H
            vector[own] += H.T @ np.linalg.inv(R) @ z[k]
    joint = np.linalg.inv(information)
    np.testing.assert_allclose(smoothed.mean.ravel(), joint @ vector, atol=1e-8)
    blocks = joint.reshape(T, n, T, n).swapaxes(1, 2)
    for i in range(T):
        np.testing.assert_allclose(smoothed.cov[i], blocks[i, i], atol=1e-8)
        for j in range(T):
            np.testing.assert_allclose(smoothing.cross_covariance(smoothed, i, j), blocks[i, j], atol=1e-8)
    np.testing.assert_allclose(smoothing.lag_one(smoothed), blocks[range(T - 1), range(1, T)], atol=1e-8)
    chosen = [0, 2, 3, 6]
    np.testing.assert_allclose(smoothing.cross_covariances(smoothed, chosen), blocks[np.ix_(chosen, chosen)], atol=1e-8)
    weights = rng.normal(size=(T, n))
    expected = weights.ravel() @ joint @ weights.ravel()
    np.testing.assert_allclose(smoothing.weighted_variance(smoothed, weights), expected, rtol=1e-8)


def test_a_single_state_is_its_own_smoothing():
    belief = Gaussian(np.zeros((1, 4)), np.eye(4)[None])
    smoothed = smoothing.rauch_tung_striebel(belief, belief, np.eye(4)[None])
    np.testing.assert_array_equal(smoothed.cov, belief.cov)
    assert smoothed.gains.shape == (0, 4, 4)


def test_extended_smoother_is_consistent_and_better_than_the_filter():
    truth, filtered, predicted, F = bicycle_run(np.random.default_rng(2), 150, 60, 0.04)
    smoothed = smoothing.rauch_tung_striebel(filtered, predicted, F, angles=(3,))
    assert np.abs(smoothed.mean[..., 3]).max() <= np.pi  # the heading starts near the seam
    error = wrap_at(smoothed.mean - truth, (3,))
    assert np.sqrt((error[..., 2] ** 2).mean()) < 0.8 * np.sqrt(((filtered.mean - truth)[..., 2] ** 2).mean())
    for k in (0, 20, 40, 59):
        nees = gaussian.mahalanobis(error[k], smoothed.cov[k])
        low, high = chi2.ppf([0.0005, 0.9995], 5 * 150) / 150
        assert low < nees.mean() < high
    assert np.linalg.eigvalsh(smoothed.cov).min() > 0
