"""Lou's extended Kalman filter: a fading factor when the car leaves the model, and noise that adapts itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from visfuse_cli.maths import gaussian
from visfuse_cli.maths.gaussian import symmetrise, transpose
from visfuse_cli.records import Array, Gaussian, Innovation

ALPHA = (0.1, 0.1, 2.8)  # weights of x, y and theta; they sum to 3. Lou 2002, sec. 4.1
MEMORY = 0.8  # share of U kept at each measurement; the paper's recursion forgets in three and spoils smooth motion
SOFTENING = 2.5  # measurement noise subtracted from U this many times, so that noise alone seldom fades
TINY = float(np.finfo(float).tiny)
LIMIT = 20.0  # largest factor; one outlier must not erase the past


@dataclass(frozen=True, slots=True)
class FadingState:
    """What the filter remembers between measurements: U (..., m, m), the empirical covariance of its residuals."""

    U: Array


@dataclass(frozen=True, slots=True)
class FadingStep:
    """One measurement taken in: the faded prior, the posterior, the innovation against that prior, lambda (...)."""

    prior: Gaussian
    posterior: Gaussian
    innovation: Innovation
    factor: Array
    state: FadingState


def start(predicted: Gaussian, H: Array, R: Array) -> FadingState:
    """The state before the first residual: the theoretical covariance H P H^T + R. Lou 2002, sec. 3.4."""
    return FadingState(symmetrise(H @ predicted.cov @ transpose(H) + R))


def fading_factor(
    U: Array,
    spread: Array,
    Q: Array,
    H: Array,
    R: Array,
    alpha: tuple[float, ...] = ALPHA,
    softening: float = SOFTENING,
    limit: float = LIMIT,
) -> Array:
    """lambda (...) in [1, limit] by which the past must fade for white residuals. Lou 2002, sec. 3.4.

    U (..., m, m) empirical covariance of the residuals, spread (..., n, n) = F P F^T, Q (..., n, n) process and
    R (..., m, m) measurement noise, alpha (m,) the weights of the measured components.
    """
    weights = np.asarray(alpha, dtype=float)

    def weighted_trace(matrix: Array) -> Array:
        return np.asarray(matrix.diagonal(0, -2, -1) @ weights)

    N = weighted_trace(U - H @ Q @ transpose(H) - softening * R)
    M = weighted_trace(H @ spread @ transpose(H))
    # The divisor is kept where the quotient stays within the limit, so that an exactly known past cannot overflow it.
    return np.asarray(np.minimum(np.maximum(N / np.maximum(M, np.abs(N) / limit + TINY), 1.0), limit))


def update(
    predicted: Gaussian,
    Q: Array,
    residual: Array,
    H: Array,
    R: Array,
    state: FadingState,
    alpha: tuple[float, ...] = ALPHA,
    memory: float = MEMORY,
    limit: float = LIMIT,
) -> FadingStep:
    """Take in one measurement after fading the past by lambda. Lou 2002, eqs. 5-11.

    predicted (..., n) is the plain prediction with covariance F P F^T + Q, Q (..., n, n) the noise it contains;
    residual (..., m) is z - h(x), angles wrapped; H (..., m, n), R (..., m, m). With limit = 1 this is the EKF.
    Raises LinAlgError where H P H^T + R is not positive definite.
    """
    U = memory * state.U + (1 - memory) * residual[..., :, None] * residual[..., None, :]
    spread = predicted.cov - Q
    factor = fading_factor(U, spread, Q, H, R, alpha, limit=limit)
    # lambda F P F^T + Q, written as an addition so that lambda = 1 leaves the prediction's bytes alone
    prior = Gaussian(predicted.mean, symmetrise(predicted.cov + (factor - 1)[..., None, None] * spread))  # eq. 11
    posterior, innovation = gaussian.update(prior, residual, H, R)
    return FadingStep(prior, posterior, innovation, factor, FadingState(U))


@dataclass(frozen=True, slots=True)
class AdaptiveNoise:
    """Process noise Q (..., n, n) and measurement noise R (..., m, m) after `count` samples."""

    Q: Array
    R: Array
    count: int = 1  # the first guess counts as one sample; with 0 the first residual would replace it


def adapt_noise(
    noise: AdaptiveNoise,
    posterior: Gaussian,
    after: Array,
    correction: Array,
    H: Array,
    floors: tuple[Array, Array],
    beta: float = 0.98,
) -> AdaptiveNoise:
    """Noise covariances after one more measurement, in forms that stay positive definite. Lou 2002, sec. 3.5.

    after (..., m) is the residual z - h(x) of the posterior (..., n), correction (..., n) the step K g it made,
    H (..., m, n); floors are the least variances of the process (n,) and of the measurement (m,); beta in (0, 1]
    is the vanishing factor, 1 averages all samples alike. Estimates are biased low (0.5 to 0.7 of the truth).
    """
    share = 1 / (noise.count + 1) if beta == 1 else (1 - beta) / (1 - beta ** (noise.count + 1))
    measured = after[..., :, None] * after[..., None, :] + H @ posterior.cov @ transpose(H)
    process = correction[..., :, None] * correction[..., None, :]
    R = _at_least((1 - share) * noise.R + share * measured, floors[1])
    Q = _at_least((1 - share) * noise.Q + share * process, floors[0])
    return AdaptiveNoise(Q, R, noise.count + 1)


def _at_least(cov: Array, variances: Array) -> Array:
    """The covariance (..., n, n) with no direction below the diagonal floor (n,): cov - diag(floor) >= 0."""
    scale = np.sqrt(variances)
    values, vectors = np.linalg.eigh(symmetrise(cov) / scale[:, None] / scale)
    lifted = (vectors * np.maximum(values, 1.0)[..., None, :]) @ transpose(vectors)
    return symmetrise(lifted * scale[:, None] * scale)
