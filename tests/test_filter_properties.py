"""What every filter keeps whatever it is given: symmetry, positive definiteness, order and unit of measure."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.drives import stacked
from tests.test_gaussian import covariance
from visfuse_cli.maths import course, covariance_updating, fading, fusion, gaussian, imm, motion
from visfuse_cli.maths.consistency import corrections
from visfuse_cli.maths.smoothing import rauch_tung_striebel
from visfuse_cli.records import Gaussian

SEEDS = st.integers(0, 2**31)
CAR = np.array([1.0, -2, 8, 0.4, 0.1, 0.5])
ADVANCE = {
    "bicycle": lambda x, P, dt: (*motion.bicycle(x, dt, 2.5), motion.bicycle_noise(x, dt, 2.5, 1.0, 0.1)),
    "covariance updating": lambda x, P, dt: covariance_updating.advance(x, P, dt, 2.5, 0.1, 1.0),
    "CS": lambda x, P, dt: (*course.advance(x, dt, course.CS), course.noise(x, dt, course.CS, 0.1, 0.1, (0.1, 0.1))),
    "CD": lambda x, P, dt: (*course.advance(x, dt, course.CD), course.noise(x, dt, course.CD, 0.1, 0.1, (0.1, 0.1))),
}


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.sampled_from(list(ADVANCE)), st.floats(0.005, 0.5), st.floats(-6, 2), st.booleans())
def test_covariances_of_cars_stay_symmetric_and_positive(seed, name, dt, noise, fades):
    rng = np.random.default_rng(seed)
    size = 5 if name == "bicycle" else 6
    belief = Gaussian(CAR[:size], np.diag([0.2, 0.2, 1, 0.1, 0.05, 0.5][:size]) ** 2)
    H, R = np.eye(size)[[0, 1, 3]], 10.0**noise * np.diag([1.0, 1.0, 0.1])
    memory = None
    for _ in range(6):
        mean, F, Q = ADVANCE[name](belief.mean, belief.cov, np.array(dt))
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        residual = rng.normal(size=3) * np.sqrt(np.diag(R))
        if fades:
            memory = memory or fading.start(ahead, H, R)
            step = fading.update(ahead, Q, residual, H, R, memory)
            belief, memory = step.posterior, step.state
            assert 1 <= step.factor <= fading.LIMIT
        else:
            belief, _ = gaussian.update(ahead, residual, H, R)
        np.testing.assert_array_equal(belief.cov, belief.cov.T)
        scale = np.sqrt(np.diag(belief.cov))
        assert np.linalg.eigvalsh(belief.cov / np.outer(scale, scale)).min() > -1e-9
        assert np.all(scale > 0)


def smoothed(unit: float, seed: int, order: tuple[int, ...] = (0, 1)) -> Gaussian:
    """A track of five instants, its positions and velocities in `unit`s of a metre, its axes in an order."""
    rng = np.random.default_rng(seed)
    axes = [*order, *(2 + k for k in order)]
    F, Q = motion.constant_velocity(0.2), unit**2 * motion.constant_velocity_noise(0.2, 0.5)
    H, R = np.eye(2, 4), unit**2 * np.diag([0.1, 0.3])[np.ix_(order, order)]
    belief, after, before = Gaussian(np.zeros(4), unit**2 * np.diag([1.0, 2, 3, 4])[np.ix_(axes, axes)]), [], []
    for _ in range(5):
        before.append(gaussian.predict(belief, F, Q))
        z = unit * rng.normal(size=2)[list(order)]
        belief, _ = gaussian.update(before[-1], z - before[-1].mean[:2], H, R)
        after.append(belief)
    return rauch_tung_striebel(stacked(after), stacked(before), np.tile(F, (5, 1, 1)))


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(1e-3, 1e3))
def test_a_smoothed_track_follows_units_and_the_order_of_axes(seed, unit):
    plain, scaled, turned = smoothed(1.0, seed), smoothed(unit, seed), smoothed(1.0, seed, (1, 0))
    np.testing.assert_allclose(scaled.mean, unit * plain.mean, rtol=1e-7, atol=1e-9 * unit)
    np.testing.assert_allclose(scaled.cov, unit**2 * plain.cov, rtol=1e-7, atol=1e-10 * unit**2)
    axes = [1, 0, 3, 2]
    np.testing.assert_allclose(turned.mean, plain.mean[:, axes], atol=1e-9)
    np.testing.assert_allclose(turned.cov, plain.cov[:, axes][:, :, axes], atol=1e-9)
    np.testing.assert_array_equal(plain.cov, np.swapaxes(plain.cov, 1, 2))
    assert np.linalg.eigvalsh(plain.cov).min() > 0


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.permutations(range(5)), st.floats(1e-2, 1e2))
def test_the_closed_loop_does_not_depend_on_the_order_of_pairs_nor_on_units(seed, order, unit):
    rng = np.random.default_rng(seed)
    prior = Gaussian(rng.normal(size=(2, 6)), covariance(rng, 2, 6))
    owner, y, R = rng.integers(0, 2, 5), rng.normal(size=(5, 3)), covariance(rng, 5, 3)
    plain = fusion.closed_loop(prior, owner, y, R)
    rows = list(order)
    scaled = Gaussian(unit * prior.mean, unit**2 * prior.cov)
    other = fusion.closed_loop(scaled, owner[rows], unit * y[rows], unit**2 * R[rows])
    np.testing.assert_allclose(other.mean, unit * plain.mean, rtol=1e-6, atol=1e-8 * unit)
    np.testing.assert_allclose(other.cov, unit**2 * plain.cov, rtol=1e-6, atol=1e-8 * unit**2)
    assert np.linalg.eigvalsh(plain.cov).min() > 0


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_mixing_a_short_state_into_a_long_one_leaves_what_they_share(seed):
    rng = np.random.default_rng(seed)
    shared = rng.normal(size=4)
    mean = np.stack([np.append(shared, [0, 0]), np.append(shared, rng.normal(size=2))])
    cov = np.stack([np.diag([1.0, 1, 1, 1, 2, 2]), covariance(rng, 6)])
    mixed, ahead = imm.mix(imm.Bank(Gaussian(mean, cov), np.log([0.3, 0.7])), imm.transition(2, 0.9))
    np.testing.assert_allclose(mixed.mean[:, :4], np.stack([shared, shared]), atol=1e-12)
    np.testing.assert_allclose(np.exp(ahead).sum(), 1, atol=1e-12)
    assert np.linalg.eigvalsh(mixed.cov).min() > 0


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_corrections_are_as_large_as_the_innovations(seed):
    rng = np.random.default_rng(seed)
    prior = Gaussian(rng.normal(size=(3, 6)), covariance(rng, 3, 6))
    after, innovation = gaussian.update(prior, rng.normal(size=(3, 3)), np.eye(3, 6), covariance(rng, 3))
    unseen = Gaussian(np.concatenate([after.mean, prior.mean]), np.concatenate([after.cov, prior.cov]))
    twice = Gaussian(np.tile(prior.mean, (2, 1)), np.tile(prior.cov, (2, 1, 1)))
    np.testing.assert_allclose(corrections(twice, unseen, 3), innovation.nis, rtol=1e-5)
