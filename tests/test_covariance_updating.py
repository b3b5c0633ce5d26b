"""Maybank's filter: its motion, its noise and what the doubt does to the mean, against differences and sampling."""

import numpy as np
import pytest

from visfuse_cli.maths import covariance_updating as cuf
from visfuse_cli.maths import motion
from visfuse_cli.maths.angles import wrap
from visfuse_cli.maths.gaussian import transpose

L = 2.5
X = np.array([1.0, -2.0, 6.0, 0.4, 0.2, 1.5])
P = np.diag([0.1, 0.1, 0.5, 0.1, 0.1, 0.5]) ** 2 + 1e-3 * np.outer(*[[0, 0, 1, 1, 1, 0]] * 2)


def test_the_jacobian_is_the_difference():
    F = cuf.steered(X, 0.3, L)[1]
    for k in range(6):
        h = 1e-6 * np.eye(6)[k]
        up, down = (cuf.steered(X + sign * h, 0.3, L)[0] for sign in (1, -1))
        np.testing.assert_allclose(F[:, k], (up - down) / 2e-6, atol=1e-6)


def test_without_acceleration_it_is_the_bicycle():
    x = np.append(X[:5], 0.0)
    np.testing.assert_allclose(cuf.steered(x, 0.4, L)[0][:5], motion.bicycle(x[:5], 0.4, L)[0], atol=1e-12)


def test_a_step_in_two_is_a_step():
    half = cuf.steered(cuf.steered(X, 0.15, L)[0], 0.15, L)
    np.testing.assert_allclose(half[0], cuf.steered(X, 0.3, L)[0], atol=1e-9)
    middle, F1, Q1 = cuf.advance(X, P, 0.05, L, 0.2, 1.0)
    end, F2, Q2 = cuf.advance(middle, F1 @ P @ F1.T + Q1, 0.05, L, 0.2, 1.0)
    whole, F, Q = cuf.advance(X, P, 0.1, L, 0.2, 1.0)
    np.testing.assert_allclose(end, whole, atol=2e-5)
    np.testing.assert_allclose(F2 @ (F1 @ P @ F1.T + Q1) @ F2.T + Q2, F @ P @ F.T + Q, atol=2e-5)


@pytest.mark.parametrize("dt", [0.04, 0.2])
def test_mean_and_covariance_are_those_of_sampled_drives(dt):
    rng = np.random.default_rng(3)
    n, steps, sa, sp = 200_000, 10, 1.0, 0.2
    # A draw and its mirror image: what is odd in the noise cancels, what the curvature does to the mean stays.
    e = rng.normal(size=(n, 6)) @ np.linalg.cholesky(P).T
    x = X + np.concatenate([e, -e])
    h = dt / steps
    for _ in range(steps):
        kick = rng.normal(size=(n, 2)) * np.array([sp, sa]) * np.sqrt(h)
        kick = np.concatenate([kick, -kick])
        x[:, 4:] += kick / 2
        x = cuf.steered(x, h, L)[0]
        x[:, 4:] += kick / 2
    mean, F, Q = cuf.advance(X, P, dt, L, sp, sa)
    off = x - cuf.steered(X, dt, L)[0]
    off[:, 3] = wrap(off[:, 3])
    drift = mean - cuf.steered(X, dt, L)[0]
    np.testing.assert_allclose(off.mean(axis=0)[:4], drift[:4], atol=0.06 * np.abs(drift[:4]).max())
    deviation = np.sqrt(np.diag(F @ P @ F.T + Q))
    np.testing.assert_allclose(np.cov(off.T) / np.outer(deviation, deviation), _correlation(F, Q), atol=0.03)


def _correlation(F, Q):
    cov = F @ P @ transpose(F) + Q
    deviation = np.sqrt(np.diag(cov))
    return cov / np.outer(deviation, deviation)
