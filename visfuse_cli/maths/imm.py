"""Interacting multiple models: filters of several motions that share what they have in common (Jia 2008, sec. 4).

All models live in one common state of size N, stacked: beliefs (..., r, N). A motion that lacks some components (a
point without acceleration, a course without turning) holds them at zero with an honest prior variance, `embedded`, so
that mixing a short state into a long one never claims to know what it does not. Probabilities are logs throughout. All
is batched over leading axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visfuse_cli.maths import gaussian
from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.maths.gaussian import symmetrise, times, transpose
from visfuse_cli.records import Array, Gaussian, Innovation

Advance = Callable[[Array], tuple[Array, Array, Array]]  # x (..., r, N) -> x', F, Q, each model by its own motion


@dataclass(frozen=True, slots=True)
class Bank:
    """What each of r models believes (..., r, N), and the models' log probabilities (..., r)."""

    beliefs: Gaussian
    log_mu: Array


@dataclass(frozen=True, slots=True)
class Step:
    """One instant: beliefs mixed and predicted (..., r, N), the way between them, log probabilities ahead, and after.

    `filtered` is the prediction itself where nothing was measured.
    """

    mixed: Gaussian
    F: Array
    Q: Array
    predicted: Gaussian
    ahead: Array
    filtered: Bank


def transition(models: int, stay: float) -> Array:
    """log p_ij (r, r), from model i to model j: `stay` on the diagonal, the rest shared. Jia 2008, eq. 37."""
    p = np.full((models, models), (1 - stay) / max(models - 1, 1))
    np.fill_diagonal(p, stay if models > 1 else 1.0)
    return np.log(p)


def embedded(F: Array, Q: Array, index: Sequence[int], spare: Array) -> tuple[Array, Array]:
    """A motion of the components `index` (n,) as one of the common state: F and Q (..., N, N) from (..., n, n).

    spare (N,) are the variances granted to what the motion lacks; that is zero after every step.
    """
    size, at = len(spare), np.array(index)
    lacked = np.ones(size, dtype=bool)
    lacked[at] = False
    F_common = np.zeros((*F.shape[:-2], size, size))
    Q_common = np.broadcast_to(np.diag(np.where(lacked, spare, 0.0)), (*Q.shape[:-2], size, size)).copy()
    F_common[..., at[:, None], at] = F
    Q_common[..., at[:, None], at] = Q
    return F_common, Q_common


def start(beliefs: Gaussian, models: int) -> Bank:
    """r models that all begin with one belief (..., N), equally likely."""
    shape = beliefs.mean.shape
    mean = np.repeat(beliefs.mean[..., None, :], models, axis=-2)
    cov = np.repeat(beliefs.cov[..., None, :, :], models, axis=-3)
    return Bank(Gaussian(mean, cov), np.full((*shape[:-1], models), -np.log(models)))


def at(step: Step, k: int) -> Step:
    """The step of one of many tracks, the k-th along the first axis."""
    mixed, predicted, after = (
        Gaussian(b.mean[k], b.cov[k]) for b in (step.mixed, step.predicted, step.filtered.beliefs)
    )
    return Step(mixed, step.F[k], step.Q[k], predicted, step.ahead[k], Bank(after, step.filtered.log_mu[k]))


def mix(bank: Bank, log_p: Array, angles: tuple[int, ...] = ()) -> tuple[Gaussian, Array]:
    """Each model's own starting point (..., r, N), and the log probabilities ahead (..., r). Jia 2008, eqs. 23-26.

    `angles` are components of the state on the circle. Bradshaw 1997, sec. 5.
    """
    joint = log_p + bank.log_mu[..., :, None]  # p_ij mu_i: (..., i, j)
    ahead = _log_sum(joint, axis=-2)  # c_j = sum_i p_ij mu_i: Jia 2008, eq. 23
    share = np.exp(transpose(joint) - ahead[..., :, None])  # mu_i|j, j first: Jia 2008, eq. 24
    return _matched(bank.beliefs, share, angles), ahead


def _matched(beliefs: Gaussian, share: Array, angles: tuple[int, ...]) -> Gaussian:
    """Gaussians (..., j, N) with the first two moments of mixtures of r beliefs, in shares (..., j, r)."""
    origin = beliefs.mean[..., :1, :]
    off = wrap_at(beliefs.mean - origin, angles)
    # Second moments about one origin near them all: the outer product of Jia 2008, eq. 26, in one matrix product.
    second = beliefs.cov + off[..., :, None] * off[..., None, :]
    r, N = off.shape[-2:]
    shift = share @ off
    mean_square = (share @ second.reshape(*off.shape[:-2], r, N * N)).reshape(*shift.shape, N)
    cov = mean_square - shift[..., :, None] * shift[..., None, :]
    return Gaussian(wrap_at(origin + shift, angles), cov)


def predict(bank: Bank, log_p: Array, advance: Advance, angles: tuple[int, ...] = ()) -> Step:
    """The bank one step ahead: mixed, then each model by its own motion. Jia 2008, eqs. 23-26, 33-34."""
    mixed, ahead = mix(bank, log_p, angles)
    mean, F, Q = advance(mixed.mean)
    predicted = Gaussian(mean, gaussian.propagate(mixed.cov, F, Q))
    F, Q = (np.broadcast_to(part, mixed.cov.shape) for part in (F, Q))
    return Step(mixed, F, Q, predicted, ahead, Bank(predicted, ahead))


def update(step: Step, residual: Array, H: Array, R: Array) -> tuple[Step, Innovation]:
    """A step after its measurement, and each model's innovation (..., r). Jia 2008, eqs. 27-29.

    residual (..., r, m) is z - h(x) of each model, angles wrapped; H (..., r, m, N) or (m, N); R likewise.
    Raises LinAlgError where H P H^T + R is not positive definite.
    """
    beliefs, innovation = gaussian.update(step.predicted, residual, H, R)
    return replace(step, filtered=Bank(beliefs, weigh(step.ahead, innovation.log_likelihood))), innovation


def weigh(ahead: Array, log_likelihood: Array) -> Array:
    """The models' log probabilities (..., r) after a measurement. Jia 2008, eqs. 28-29, the sum over j."""
    total = ahead + log_likelihood
    return np.asarray(total - _log_sum(total, axis=-1)[..., None])


def combined(bank: Bank, angles: tuple[int, ...] = ()) -> Gaussian:
    """One belief (..., N) for all models. Jia 2008, eqs. 30-31."""
    one = _matched(bank.beliefs, np.exp(bank.log_mu)[..., None, :], angles)
    return Gaussian(one.mean[..., 0, :], symmetrise(one.cov[..., 0, :, :]))


def smooth(steps: Sequence[Step], log_p: Array, angles: tuple[int, ...] = ()) -> list[Bank]:
    """Every instant's bank given the whole recording: a fixed-interval smoother over pairs of models.

    Each model of now is smoothed by each model of the next instant, and the pairs are weighed by how likely the one
    followed the other (Kim 1994, Dynamic linear models with Markov switching). With one model this is the
    Rauch-Tung-Striebel pass. Raises LinAlgError where a predicted covariance is singular.
    """
    banks = [steps[-1].filtered]
    for now, after in zip(steps[-2::-1], steps[:0:-1], strict=True):
        banks.append(_smoothed(now.filtered, after, banks[-1], log_p, angles))
    return banks[::-1]


def _smoothed(now: Bank, after: Step, later: Bank, log_p: Array, angles: tuple[int, ...]) -> Bank:
    """The bank now, given the smoothed bank one step later."""
    joint = log_p + now.log_mu[..., :, None] - after.ahead[..., None, :] + later.log_mu[..., None, :]  # (..., j, i)
    log_mu = _log_sum(joint, axis=-1)
    share = np.exp(joint - log_mu[..., None])
    P, F, Q = now.beliefs.cov[..., :, None, :, :], after.F[..., None, :, :, :], after.Q[..., None, :, :, :]
    off = wrap_at(now.beliefs.mean[..., :, None, :] - after.mixed.mean[..., None, :, :], angles)
    expected = times(F, off) + after.predicted.mean[..., None, :, :]
    F_P = F @ P
    gain = transpose(np.linalg.solve(symmetrise(F_P @ transpose(F) + Q), F_P))
    surprise = wrap_at(later.beliefs.mean[..., None, :, :] - expected, angles)
    moved = times(gain, surprise)  # of model j now, by model i next: (..., j, i, N)
    keep = np.eye(P.shape[-1]) - gain @ F
    cov = keep @ P @ transpose(keep) + gain @ (Q + later.beliefs.cov[..., None, :, :, :]) @ transpose(gain)
    shift = np.sum(share[..., None] * moved, axis=-2)
    spread = moved - shift[..., :, None, :]
    matched = np.sum(share[..., None, None] * (cov + spread[..., :, None] * spread[..., None, :]), axis=-3)
    return Bank(Gaussian(wrap_at(now.beliefs.mean + shift, angles), symmetrise(matched)), log_mu)


def _log_sum(values: Array, axis: int) -> Array:
    top = np.max(values, axis=axis, keepdims=True)
    return np.asarray(np.squeeze(top, axis) + np.log(np.sum(np.exp(values - top), axis=axis)))
