"""The Gaussian belief: predict, update, density, moment matching; batched over all leading dimensions."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.records import Array, Gaussian, Innovation

# As arrays: with a float, numpy takes twice as long over small ones.
HALF, MINUS_HALF, HALF_LOG_TAU = np.array(0.5), np.array(-0.5), np.array(0.5 * np.log(2 * np.pi))
AMPLE = 1e200  # above any squared residual in units of its deviation, and any inverse variance


def transpose(matrix: NDArray[Any]) -> Array:
    """Matrices (..., n, m) transposed to (..., m, n)."""
    return matrix.swapaxes(-1, -2)


def symmetrise(cov: Array) -> Array:
    """The symmetric part of covariances (..., n, n); the one place where rounding's asymmetry is removed."""
    twice = cov + transpose(cov)
    twice *= HALF
    return twice


def inverse(cov: Array) -> Array:
    """The information matrices (..., n, n) of covariances; raises LinAlgError where one is singular."""
    return symmetrise(np.asarray(np.linalg.inv(cov), dtype=float))


def times(matrix: Array, vector: Array) -> Array:
    """Matrices (..., n, m) times vectors (..., m): (..., n)."""
    return (matrix @ vector[..., None])[..., 0]


def predict(belief: Gaussian, F: Array, Q: Array) -> Gaussian:
    """Belief (..., n) through the linear motion F (..., n, n) with noise Q (..., n, n).

    For a nonlinear motion take `propagate`'s covariance and the motion's own mean. Jia 2008, eqs. 33-34.
    """
    return Gaussian(times(F, belief.mean), propagate(belief.cov, F, Q))


def propagate(cov: Array, F: Array, Q: Array) -> Array:
    """Covariance (..., n, n) one step ahead: F P F^T + Q, symmetric but for rounding. Lou 2002, eq. 8."""
    ahead: Array = F @ cov @ transpose(F) + Q
    return ahead


def innovate(belief: Gaussian, residual: Array, H: Array, R: Array) -> Innovation:
    """What a measurement says about a belief (..., n). Lou 2002, eq. 7.

    residual (..., m) is z - h(x), its angles wrapped by the caller; H (..., m, n); R (..., m, m).
    Raises LinAlgError where H P H^T + R is not positive definite.
    """
    return _weighed(belief.cov, residual, H, R)[0]


def update(belief: Gaussian, residual: Array, H: Array, R: Array) -> tuple[Gaussian, Innovation]:
    """Belief (..., n) after a measurement, in Joseph form; arguments as in `innovate`. Lou 2002, eqs. 5, 9.

    Raises LinAlgError where H P H^T + R is not positive definite.
    """
    innovation, P_H, below = _weighed(belief.cov, residual, H, R)
    moved = P_H @ below[..., :-1, :] @ transpose(below)  # P H^T S^-1 [I, r]: the gain, and the mean's step
    K = moved[..., :-1]
    # (I - K H) P (I - K H)^T + K R K^T, grouped as Bierman 1977 does: no matrix product of full size is left, and what
    # rounding leaves of a vague prior in M is still taken out by the second factor.
    M = belief.cov - K @ transpose(P_H)
    left = K @ R
    left -= M @ transpose(H)
    M += left @ transpose(K)
    return Gaussian(belief.mean + moved[..., -1], symmetrise(M)), innovation


def _weighed(P: Array, residual: Array, H: Array, R: Array) -> tuple[Innovation, Array, NDArray[Any]]:
    """A measurement against a covariance: the innovation, P H^T (..., n, m), and [I; r^T] L^-T (..., m + 1, m).

    L is the Cholesky factor of S. S^-1 itself is never formed: as a factor it would cost a vague prior its digits.
    """
    P_H = P @ transpose(H)
    S = H @ P_H + R
    m = S.shape[-1]
    if residual.shape != S.shape[:-1]:
        residual = np.broadcast_to(residual, np.broadcast_shapes(residual.shape, S.shape[:-1]))
    # One factorisation does it all: below the factor L of S, that of [[S, .], [B, c I]] holds B L^-T; B is [I; r^T].
    border = _border(m)
    joint = np.empty(residual.shape[:-1] + border.shape)
    joint[...] = border
    joint[..., :m, :m] = S
    joint[..., -1, :m] = residual
    factor = np.linalg.cholesky(joint)
    fit = _fit(factor[..., -1, :m], factor[..., :m, :m])
    return Innovation(residual, S, *fit), P_H, factor[..., m:, :m]


@cache
def _border(m: int) -> Array:
    """What surrounds a covariance (m, m) to be factorised: below it the identity and one row to be whitened."""
    frame = AMPLE * np.eye(2 * m + 1)
    frame[m:-1, :m] = np.eye(m)
    frame.flags.writeable = False
    return frame


def log_density(residual: Array, cov: Array) -> Array:
    """Log of the normal density (...) at residuals (..., n) with covariances (..., n, n).

    Raises LinAlgError where a covariance is not positive definite.
    """
    return _density(residual, cov)[1]


def mahalanobis(residual: Array, cov: Array) -> Array:
    """Squared Mahalanobis length (...) of residuals (..., n) with covariances (..., n, n).

    Raises LinAlgError where a covariance is not positive definite.
    """
    return _density(residual, cov)[0]


def _density(residual: Array, cov: Array) -> tuple[Array, Array]:
    L = np.linalg.cholesky(cov)
    return _fit(np.linalg.solve(L, residual[..., None])[..., 0], L)


def _fit(whitened: NDArray[Any], L: NDArray[Any]) -> tuple[Array, Array]:
    """Squared length of residuals (..., n) whitened by the Cholesky factors L (..., n, n), and log normal density."""
    ones = _ones(L.shape[-1])
    squared = (whitened * whitened).dot(ones)
    log_density = squared * MINUS_HALF
    log_density -= (np.log(L.diagonal(0, -2, -1)) + HALF_LOG_TAU).dot(ones)
    return squared, log_density


@cache
def _ones(n: int) -> Array:
    """By a product with these, few numbers are summed in half the time."""
    return np.ones(n)


def moment_match(means: Array, covs: Array, log_weights: Array, angles: tuple[int, ...] = ()) -> Gaussian:
    """One Gaussian (..., n) with the mean and covariance of a mixture of M. Jia 2008, eqs. 30-31.

    means (..., M, n), covs (..., M, n, n), log_weights (..., M) up to a common constant; components listed in
    `angles` (rad) are averaged on the circle, around the heaviest component.
    """
    weights = np.exp(log_weights - np.max(log_weights, axis=-1, keepdims=True))
    weights = weights / np.sum(weights, axis=-1, keepdims=True)
    heaviest = np.argmax(weights, axis=-1)[..., None, None]
    origin = np.take_along_axis(means, heaviest, axis=-2)
    offsets = wrap_at(means - origin, angles)
    shift = np.sum(weights[..., None] * offsets, axis=-2)
    spread = offsets - shift[..., None, :]
    cov = np.sum(weights[..., None, None] * (covs + spread[..., :, None] * spread[..., None, :]), axis=-3)
    return Gaussian(wrap_at(origin[..., 0, :] + shift, angles), symmetrise(cov))
