"""The particle filter's core against the Kalman filter, the Rauch-Tung-Striebel pass, and its own invariants."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from tests.drives import stacked
from visfuse_cli.maths import gaussian, motion, particles
from visfuse_cli.maths.smoothing import rauch_tung_striebel
from visfuse_cli.records import Gaussian

DT, STEPS, SIGMA = 0.3, 8, 0.3
F, Q = motion.constant_velocity(DT, 1), motion.constant_velocity_noise(DT, 1.0, 1)
H, R, P0 = np.eye(1, 2), np.array([[SIGMA**2]]), np.diag([0.25, 0.5])
ROOT_Q, ROOT_P = np.linalg.cholesky(Q), np.linalg.cholesky(P0)


def measured(seed: int, tracks: int) -> tuple[np.ndarray, np.ndarray]:
    """True states (T, tracks, 2) of walks by the model, and what is seen of them (T, tracks, 1)."""
    rng = np.random.default_rng(seed)
    x, truth = rng.normal(size=(tracks, 2)) @ ROOT_P.T, []
    for _ in range(STEPS):
        x = x @ F.T + rng.normal(size=x.shape) @ ROOT_Q.T
        truth.append(x)
    return np.array(truth), np.array(truth)[..., :1] + SIGMA * rng.normal(size=(STEPS, tracks, 1))


def filtered_by_particles(z: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (T, tracks, P, 2) and log weights (T, tracks, P) after each measurement."""
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(z.shape[1], count, 2)) @ ROOT_P.T
    log_weights = np.full(states.shape[:-1], -np.log(count))
    clouds, weights = [], []
    for seen in z:
        states, log_weights = particles.renewed(states, log_weights, rng)
        states = states @ F.T + rng.normal(size=states.shape) @ ROOT_Q.T
        log_weights = particles.normalised(log_weights + gaussian.log_density(seen[:, None] - states[..., :1], R))
        clouds.append(states)
        weights.append(log_weights)
    return np.array(clouds), np.array(weights)


def kalman(z: np.ndarray) -> tuple[Gaussian, Gaussian]:
    belief = Gaussian(np.zeros((z.shape[1], 2)), np.broadcast_to(P0, (z.shape[1], 2, 2)))
    after, before = [], []
    for seen in z:
        before.append(gaussian.predict(belief, F, Q))
        belief, _ = gaussian.update(before[-1], seen - before[-1].mean[:, :1], H, R)
        after.append(belief)
    return stacked(after), stacked(before)


def log_transition(now: np.ndarray, later: np.ndarray, k: int) -> np.ndarray:
    white = np.linalg.inv(ROOT_Q).T
    return -0.5 * np.sum(((now @ F.T @ white)[:, None] - later @ white) ** 2, axis=-1)


def test_of_a_linear_gaussian_walk_the_particles_are_the_kalman_filter():
    _, z = measured(1, 3)
    clouds, weights = filtered_by_particles(z, 20_000, 2)
    exact, _ = kalman(z)
    found = particles.moments(clouds, weights)
    deviation = np.sqrt(np.diagonal(exact.cov, axis1=-2, axis2=-1))
    np.testing.assert_allclose((found.mean - exact.mean) / deviation, 0, atol=0.06)
    np.testing.assert_allclose(
        found.cov / (deviation[..., None] * deviation[..., None, :]), correlation(exact), atol=0.06
    )


def correlation(belief: Gaussian) -> np.ndarray:
    deviation = np.sqrt(np.diagonal(belief.cov, axis1=-2, axis2=-1))
    return belief.cov / (deviation[..., None] * deviation[..., None, :])


def test_backward_draws_are_the_rauch_tung_striebel_smoother():
    _, z = measured(3, 1)
    clouds, weights = filtered_by_particles(z, 6000, 4)
    ways = particles.backward_draws(clouds[:, 0], weights[:, 0], log_transition, np.random.default_rng(5), 600)
    after, before = kalman(z)
    exact = rauch_tung_striebel(after, before, np.broadcast_to(F, (STEPS, 1, 2, 2)))
    deviation = np.sqrt(np.diagonal(exact.cov, axis1=-2, axis2=-1))[:, 0]
    filter_off, smoother_off = ((m - exact.mean[:, 0]) / deviation for m in (after.mean[:, 0], ways.mean(axis=1)))
    assert np.sqrt(np.mean(filter_off**2)) > 1
    assert np.sqrt(np.mean(smoother_off**2)) < 0.2
    assert np.mean(ways.std(axis=1) / deviation) == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(ways.std(axis=1) / deviation, 1, atol=0.25)


def test_their_errors_are_as_large_as_the_cloud_says():
    truth, z = measured(6, 200)
    clouds, weights = filtered_by_particles(z, 500, 7)
    low, high = chi2.ppf([0.0005, 0.9995], 2 * 200) / 200
    for k in (STEPS // 2, STEPS - 1):
        belief = particles.moments(clouds[k], weights[k])
        assert low < gaussian.mahalanobis(belief.mean - truth[k], belief.cov).mean() < high


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 3), st.floats(0.1, 30), st.floats(-1e5, 1e5))
def test_weights_are_probabilities_whatever_their_scale(seed, tracks, spread, shift):
    raw = spread * np.random.default_rng(seed).normal(size=(tracks, 50))
    log_weights = particles.normalised(raw)
    np.testing.assert_allclose(np.exp(log_weights).sum(axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(particles.normalised(raw + shift), log_weights, atol=1e-9)
    number = particles.effective_number(log_weights)
    assert np.all((number > 0.999) & (number < 50.001))
    assert particles.effective_number(np.full(50, -np.log(50))) == pytest.approx(50)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.permutations(range(12)))
def test_systematic_draws_come_as_often_as_they_weigh_in_any_order(seed, order):
    rng = np.random.default_rng(seed)
    log_weights = particles.normalised(2 * rng.normal(size=(3, 12)))[:, list(order)]
    index = particles.systematic(log_weights, rng, 100)
    for row, drawn in zip(log_weights, index, strict=True):
        count = np.bincount(drawn, minlength=12)
        assert np.abs(count - 100 * np.exp(row)).max() < 1 + 1e-9  # what systematic draws promise


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.001, 1000))
def test_moments_are_symmetric_positive_and_follow_the_unit(seed, unit):
    rng = np.random.default_rng(seed)
    states, log_weights = rng.normal(size=(2, 80, 3)), particles.normalised(rng.normal(size=(2, 80)))
    plain, scaled = particles.moments(states, log_weights), particles.moments(unit * states, log_weights)
    np.testing.assert_allclose(scaled.mean, unit * plain.mean, rtol=1e-9, atol=1e-12 * unit)
    np.testing.assert_allclose(scaled.cov, unit**2 * plain.cov, rtol=1e-9, atol=1e-12 * unit**2)
    np.testing.assert_array_equal(plain.cov, np.swapaxes(plain.cov, -1, -2))
    assert np.linalg.eigvalsh(plain.cov).min() > 0


def test_jitter_keeps_the_moments_and_parts_what_was_drawn_twice():
    rng = np.random.default_rng(8)
    states, log_weights = rng.normal(size=(20_000, 2)) @ np.array([[1, 0.5], [0, 0.3]]), np.zeros(20_000)
    log_weights[:100] = 8.0
    log_weights = particles.normalised(log_weights)
    drawn, equal = particles.renewed(states, log_weights, rng, jitter=1.0)
    before, after = particles.moments(states, log_weights), particles.moments(drawn, equal)
    np.testing.assert_allclose(after.mean, before.mean, atol=0.02)
    np.testing.assert_allclose(after.cov, before.cov, atol=0.03)
    assert len(np.unique(drawn, axis=0)) == 20_000
    kept, weights = particles.renewed(drawn, equal, rng)
    assert kept is drawn
    assert weights is equal


def test_a_cloud_in_which_no_particle_is_possible_is_refused():
    with pytest.raises(ValueError, match="no particle"):
        particles.normalised(np.array([[0.0, 1.0], [-np.inf, -np.inf]]))


def test_a_measurement_far_sharper_than_the_cloud_matches_the_kalman_filter():
    rng = np.random.default_rng(5)
    H, R = np.array([[1.0, 0.5, 0.0], [0.2, 0.0, 1.0]]), np.diag([1e-3, 2e-3]) ** 2
    prior = Gaussian(np.array([1.0, -2.0, 0.5]), np.diag([2.0, 3.0, 1.0]) ** 2)
    z = np.array([1.7, -0.4])
    exact, innovation = gaussian.update(prior, z - H @ prior.mean, H, R)

    def log_likelihood(states):
        return gaussian.log_density(z - states @ H.T, R)

    shift = 0.3 * np.linalg.cholesky(exact.cov) @ np.ones(3)
    off = Gaussian(exact.mean + shift, 1.3 * exact.cov)  # a proposal need not be right
    states, log_weights, evidence = particles.imported(prior, off, log_likelihood, 2000, rng)
    found = particles.moments(states, log_weights)
    assert particles.effective_number(log_weights) > 1000
    np.testing.assert_allclose(found.mean, exact.mean, atol=4 * np.sqrt(np.diag(exact.cov).max() / 1000))
    np.testing.assert_allclose(np.diag(found.cov), np.diag(exact.cov), rtol=0.15)
    assert abs(evidence - innovation.log_likelihood) < 0.1


def test_drawn_states_have_exactly_the_beliefs_moments():
    belief = Gaussian(np.array([3.0, -1.0]), np.array([[4.0, 1.9], [1.9, 1.0]]))
    states = particles.drawn(belief, 12, np.random.default_rng(0))
    np.testing.assert_allclose(states.mean(axis=0), belief.mean, atol=1e-12)
    np.testing.assert_allclose(np.cov(states.T, bias=True), belief.cov, atol=1e-12)


@pytest.mark.parametrize("sharpness", [1e-3, 3.0, 1e4])
def test_as_much_of_a_likelihood_is_borne_as_leaves_the_particles_effective(sharpness):
    rng = np.random.default_rng(1)
    log_weights = np.full(300, -np.log(300))
    said = -sharpness * rng.normal(size=300) ** 2
    share = particles.bearable(log_weights, said, 0.5)
    left = particles.effective_number(particles.normalised(log_weights + share * said))
    assert left >= 149
    assert share == 1.0 or left < 160
