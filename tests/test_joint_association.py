"""Joint probabilistic data association against the sum over all events, and where tracks cross."""

from itertools import product

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from visfuse_cli.maths import gaussian, joint_association
from visfuse_cli.maths.assignment import assign
from visfuse_cli.maths.joint_association import probabilities
from visfuse_cli.records import Gaussian

FALSE = 6.0  # measurements of nobody, in 36 m^2


def every_event(log_likelihood: np.ndarray, p_detect: float, clutter: float) -> np.ndarray:
    """The same by counting out all joint events."""
    n, m = log_likelihood.shape
    total = np.zeros((n, m + 1))
    for event in product(range(m + 1), repeat=n):
        taken = [j for j in event if j < m]
        if len(set(taken)) < len(taken):
            continue
        weight = (1 - p_detect) ** (n - len(taken))
        for i, j in enumerate(event):
            if j < m:
                weight *= p_detect * np.exp(log_likelihood[i, j]) / clutter
        total[range(n), event] += weight
    return total / total.sum(axis=1, keepdims=True)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 5), st.floats(0.05, 0.98))
def test_shares_are_those_of_all_joint_events(seed, n, m, p_detect):
    rng = np.random.default_rng(seed)
    log_likelihood = np.where(rng.random((n, m)) < 0.3, -np.inf, 3 * rng.normal(size=(n, m)))
    found = probabilities(log_likelihood, p_detect, 0.3)
    np.testing.assert_allclose(found, every_event(log_likelihood, p_detect, 0.3), atol=1e-10)
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-12)
    assert np.all(found[:, :-1].sum(axis=0) < 1 + 1e-9)  # a measurement is at most one track's


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.01, 100))
def test_shares_follow_the_order_and_do_not_depend_on_units(seed, unit):
    rng = np.random.default_rng(seed)
    log_likelihood = 2 * rng.normal(size=(3, 4))
    rows, columns = rng.permutation(3), rng.permutation(4)
    plain = probabilities(log_likelihood, 0.9, 0.2)
    other = probabilities(log_likelihood[np.ix_(rows, columns)] - 2 * np.log(unit), 0.9, 0.2 / unit**2)
    np.testing.assert_allclose(other[:, :-1], plain[np.ix_(rows, columns)], atol=1e-9)


def test_in_large_knots_messages_come_close_to_the_sum():
    rng = np.random.default_rng(2)
    tracks = rng.uniform(0, 6, size=(9, 2))
    z = np.concatenate([tracks + 0.4 * rng.normal(size=tracks.shape), rng.uniform(0, 6, size=(1, 2))])
    log_likelihood = gaussian.log_density(z[None] - tracks[:, None], 0.32 * np.eye(2))
    odds = np.exp(log_likelihood + np.log(9.0) - np.log(0.03))
    exact, near = joint_association._summed(odds), joint_association._passed(odds)
    assert np.abs(exact - near).max() < 0.06
    more = probabilities(np.concatenate([log_likelihood, log_likelihood[:, :5]], axis=1), 0.9, 0.03)
    np.testing.assert_allclose(more.sum(axis=1), 1, atol=1e-12)
    assert more.min() >= 0


def test_one_track_and_one_sure_measurement_are_the_kalman_filter():
    belief = Gaussian(np.zeros((1, 2)), np.eye(2)[None])
    H, R, z = np.array([[1.0, 0]]), np.array([[0.1]]), np.array([[0.4]])
    share = probabilities(gaussian.log_density(z[None] - 0.0, np.array([[1.1]])), 1 - 1e-12, 1e-12)
    found = joint_association.update(belief, z, H, R, share)
    kalman, _ = gaussian.update(belief, z - belief.mean[:, :1], H, R)
    np.testing.assert_allclose(found.mean, kalman.mean, atol=1e-9)
    np.testing.assert_allclose(found.cov, kalman.cov, atol=1e-9)
    missed = joint_association.update(belief, z, H, R, np.array([[0.0, 1.0]]))
    np.testing.assert_allclose(missed.mean, belief.mean)
    np.testing.assert_allclose(missed.cov, belief.cov)


def test_without_tracks_or_measurements_there_is_nothing_to_share():
    assert probabilities(np.zeros((0, 3)), 0.9, 0.1).shape == (0, 4)
    np.testing.assert_array_equal(probabilities(np.zeros((2, 0)), 0.9, 0.1), [[1.0], [1.0]])


def test_among_false_measurements_shares_know_their_error_and_choices_do_not():
    shared, chosen = _doubt(True), _doubt(False)
    assert shared < 0.5 * chosen
    assert shared < 10  # 4 were right; a track lost now and then weighs much


def _doubt(joint: bool, pairs: int = 30) -> float:
    """Mean normalised error squared of two tracks side by side among false measurements, over many pairs of them."""
    rng = np.random.default_rng(1)
    F, H, R = np.array([[1.0, 0, 0.1, 0], [0, 1, 0, 0.1], [0, 0, 1, 0], [0, 0, 0, 1]]), np.eye(2, 4), 0.04 * np.eye(2)
    Q = np.diag([1e-6, 1e-6, 0.02, 0.02])
    nees = []
    for _ in range(pairs):
        start = np.diag([0.05] * 4)
        belief = Gaussian(np.array([[0, 0, 1.2, 0], [0, 2.0, 1.2, 0.0]]), np.tile(start, (2, 1, 1)))
        truth = belief.mean + np.sqrt(0.05) * rng.normal(size=(2, 4))
        for _ in range(25):
            truth = truth @ F.T + rng.normal(size=(2, 4)) * np.sqrt(np.diag(Q))
            seen = truth[rng.random(2) < 0.9, :2]
            false = rng.uniform(-3, 3, size=(rng.poisson(FALSE), 2)) + truth[0, :2]
            z = np.concatenate([seen + 0.2 * rng.normal(size=seen.shape), false])
            belief = gaussian.predict(belief, F, Q)
            residual = z[None] - belief.mean[:, None, :2]
            S = belief.cov[:, None, :2, :2] + R
            log_likelihood = gaussian.log_density(residual, S)
            log_likelihood = np.where(gaussian.mahalanobis(residual, S) < 13.8, log_likelihood, -np.inf)
            share = probabilities(log_likelihood, 0.9, FALSE / 36) if joint else _choice(log_likelihood)
            belief = joint_association.update(belief, z, H, R, share)
        nees.append(gaussian.mahalanobis(belief.mean - truth, belief.cov).mean())
    return float(np.mean(nees))


def _choice(log_likelihood: np.ndarray) -> np.ndarray:
    """The likeliest one-to-one assignment, as shares of one or nothing."""
    pairs, alone, _ = assign(-log_likelihood)
    share = np.zeros((len(log_likelihood), log_likelihood.shape[1] + 1))
    share[pairs[:, 0], pairs[:, 1]] = 1
    share[alone, -1] = 1
    return share
