"""Interacting multiple models: filters of several motions that share what they have in common (Jia 2008, sec. 4).

All models live in one common state of size N, stacked: beliefs (..., r, N). A motion that lacks some components (a
point without acceleration, a course without turning) holds them at zero with an honest prior variance, `embedded`, so
that mixing a short state into a long one never claims to know what it does not. Probabilities are logs throughout. All
is batched over leading axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from visfuse_cli.maths import gaussian
from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.maths.gaussian import symmetrise, times, transpose
from visfuse_cli.records import Array, Gaussian, Innovation

LEAST_LEFT, LEAST_KNOWN = 1e-12, 1e-9  # shares of a variance: rounding, below
LEAST_LIKELY = np.array(np.finfo(float).tiny)  # a probability that can still be divided by
Advance = Callable[[Array], tuple[Array, Array, Array]]  # x (..., r, N) -> x', F, Q, each model by its own motion


class Moments(NamedTuple):
    """How r models of probabilities mu (..., r) lie about the mean (..., 1, N) of them all.

    off (..., r, N) is what each one's mean differs by, second (..., r, N N) its second moments about the common one.
    """

    angles: tuple[int, ...]
    mu: Array
    mean: Array
    off: Array
    second: Array

    def together(self) -> Gaussian:
        """One belief (..., N) with the mean and covariance of all."""
        mean = self.mean[..., 0, :]
        return Gaussian(mean, _shared(self.mu[..., None, :], self.second).reshape(*mean.shape, -1))


@dataclass(slots=True)
class Bank:
    """What each of r models believes (..., r, N), and the models' log probabilities (..., r); both for good."""

    beliefs: Gaussian
    log_mu: Array
    _moments: Moments | None = field(default=None, init=False, repr=False, compare=False)

    def moments(self, angles: tuple[int, ...]) -> Moments:
        """How the models lie about their mean: made once, for `combined` and for the next `mix`."""
        if self._moments is None or self._moments.angles != angles:
            self._moments = _moments(self.beliefs, np.exp(self.log_mu), angles)
        return self._moments


class Step(NamedTuple):
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
    with np.errstate(divide="ignore"):  # over no time at all nothing changes
        return np.asarray(np.log(p))


def changes(models: int, dt: float, sojourn: float) -> Array:
    """log p_ij (r, r) over dt (s), each model lasting `sojourn` (s) on the average. Jia 2008, eq. 37, at any rate.

    A change may come at any instant, to any other model: two half steps are one whole step.
    """
    if models == 1:
        return transition(1, 1.0)
    return transition(models, float((1 + (models - 1) * np.exp(-models / (models - 1) * dt / sojourn)) / models))


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
    known, p = bank.moments(angles), np.exp(log_p)
    c = np.maximum(known.mu.dot(p), LEAST_LIKELY)  # c_j = sum_i p_ij mu_i: Jia 2008, eq. 23
    share = p.T * known.mu[..., None, :]
    share /= c[..., None]  # mu_i|j, j first: Jia 2008, eq. 24
    shift = _shared(share, known.off)
    cov = _shared(share, known.second).reshape(*shift.shape, -1)
    cov -= shift[..., :, None] * shift[..., None, :]  # from about the common mean to about each one's own
    return Gaussian(wrap_at(known.mean + shift, angles), cov), np.log(c)


def _moments(beliefs: Gaussian, mu: Array, angles: tuple[int, ...]) -> Moments:
    """How r beliefs (..., r, N) of probabilities mu (..., r) lie about their mean."""
    means, share = beliefs.mean, mu[..., None, :]
    if angles:
        near = means[..., :1, :]
        mean = wrap_at(near + _shared(share, wrap_at(means - near, angles)), angles)
    else:
        mean = _shared(share, means)
    off = wrap_at(means - mean, angles)
    second = off[..., :, None] * off[..., None, :]  # the outer product of Jia 2008, eq. 26
    second += beliefs.cov
    return Moments(angles, mu, mean, off, second.reshape(*off.shape[:-1], -1))


def _shared(share: Array, rows: Array) -> Array:
    """Sums (..., j, n) of rows (..., r, n) in shares (..., j, r)."""
    return share.dot(rows) if share.ndim == 2 else share @ rows  # the same for one track, in half the time


def predict(bank: Bank, log_p: Array, advance: Advance, angles: tuple[int, ...] = ()) -> Step:
    """The bank one step ahead: mixed, then each model by its own motion. Jia 2008, eqs. 23-26, 33-34."""
    mixed, ahead = mix(bank, log_p, angles)
    mean, F, Q = advance(mixed.mean)
    predicted = Gaussian(mean, gaussian.propagate(mixed.cov, F, Q))
    if not F.shape == Q.shape == mixed.cov.shape:
        F, Q = np.broadcast_to(F, mixed.cov.shape), np.broadcast_to(Q, mixed.cov.shape)
    return Step(mixed, F, Q, predicted, ahead, Bank(predicted, ahead))


def update(step: Step, residual: Array, H: Array, R: Array) -> tuple[Step, Innovation]:
    """A step after its measurement, and each model's innovation (..., r). Jia 2008, eqs. 27-29.

    residual (..., r, m) is z - h(x) of each model, angles wrapped; H (..., r, m, N) or (m, N); R likewise.
    Raises LinAlgError where H P H^T + R is not positive definite.
    """
    beliefs, innovation = gaussian.update(step.predicted, residual, H, R)
    after = Bank(beliefs, weigh(step.ahead, innovation.log_likelihood))
    return Step(step.mixed, step.F, step.Q, step.predicted, step.ahead, after), innovation


def weigh(ahead: Array, log_likelihood: Array) -> Array:
    """The models' log probabilities (..., r) after a measurement. Jia 2008, eqs. 28-29, the sum over j."""
    log_mu = ahead + log_likelihood
    log_mu -= np.logaddexp.reduce(log_mu, axis=-1, keepdims=True)
    return log_mu


def combined(bank: Bank, angles: tuple[int, ...] = ()) -> Gaussian:
    """One belief (..., N) for all models. Jia 2008, eqs. 30-31."""
    return bank.moments(angles).together()


def smooth(steps: Sequence[Step], log_p: Array, angles: tuple[int, ...] = ()) -> list[Bank]:
    """Every instant's bank given the whole recording, as `backward` tells them; log_p (r, r)."""
    told = backward(len(steps), lambda k: steps[k].filtered, lambda k, _: (steps[k], log_p), angles)
    return list(told)[::-1]


def backward(
    instants: int,
    filtered: Callable[[int], Bank],
    way: Callable[[int, Bank], tuple[Step, Array]],
    angles: tuple[int, ...] = (),
) -> Iterator[Bank]:
    """Every instant's bank given the whole recording, the last first: a fixed-interval smoother over pairs of models.

    filtered(k) is the bank after instant k; way(k, filtered(k - 1)) the step that led there (its own `filtered` is not
    read) and log p_ij (r, r) over it: kept, or made again, so that banks are all that has to be kept.
    What the future says of the state, if model i comes next, is the step back from model i's smoothed state, less what
    it began with; each model j of now takes it in as a measurement, and the pairs are weighed by how well j fits it.
    With one model this is the Rauch-Tung-Striebel pass. Raises LinAlgError where a covariance is singular.
    """
    later = filtered(instants - 1)
    yield later
    for k in range(instants - 1, 0, -1):
        now = filtered(k - 1)
        later = _smoothed(now, *way(k, now), later, angles)
        yield later


def _smoothed(now: Bank, after: Step, log_p: Array, later: Bank, angles: tuple[int, ...]) -> Bank:
    """The bank now, given the smoothed bank one step later."""
    H, value = _of_the_future(after, later, angles)
    P = now.beliefs.cov[..., :, None, :, :]  # of model j now, before model i: (..., j, i, n, n)
    off = wrap_at(now.beliefs.mean[..., :, None, :] - after.mixed.mean[..., None, :, :], angles)
    H_ji = np.broadcast_to(H[..., None, :, :, :], (*off.shape, off.shape[-1]))
    residual = value[..., None, :, :] - times(H_ji, off)
    moved, said = gaussian.update(Gaussian(0 * off, P), residual, H_ji, np.eye(off.shape[-1]))
    share = log_p + now.log_mu[..., :, None] + said.log_likelihood
    share = share - _log_sum(share, axis=-2)[..., None, :]  # of j, given i next and all that was seen
    joint = share + later.log_mu[..., None, :]
    log_mu = _log_sum(joint, axis=-1)
    one = _moments(moved, np.exp(joint - log_mu[..., None]), ()).together()
    return Bank(Gaussian(wrap_at(now.beliefs.mean + one.mean, angles), symmetrise(one.cov)), log_mu)


def _of_the_future(after: Step, later: Bank, angles: tuple[int, ...]) -> tuple[Array, Array]:
    """What all that comes says of the state now, if model i is next: a measurement H (..., i, n, n) of unit noise.

    Its value (..., i, n) is of the state less model i's mixed one. Where the future says nothing, H has rows of zeros.
    """
    M, F = after.mixed.cov, after.F
    F_M = F @ M
    gain = transpose(np.linalg.solve(after.predicted.cov, F_M))
    shift = times(gain, wrap_at(later.beliefs.mean - after.predicted.mean, angles))
    keep = np.eye(M.shape[-1]) - gain @ F
    S = symmetrise(keep @ M @ transpose(keep) + gain @ (after.Q + later.beliefs.cov) @ transpose(gain))
    L = np.linalg.cholesky(M)
    L_S = np.linalg.solve(L, S)
    left, V = np.linalg.eigh(symmetrise(np.linalg.solve(L, transpose(L_S))))  # doubt left, as a share of what there was
    known = np.clip(1 / np.maximum(left, LEAST_LEFT) - 1, 0, None)
    root = np.sqrt(np.where(known > LEAST_KNOWN, known, 0.0))
    V_T = transpose(V)
    whitened = times(V_T, np.linalg.solve(L, shift[..., None])[..., 0])
    value = np.divide(whitened * (1 + known), root, out=np.zeros_like(root), where=root > 0)
    return root[..., None] * V_T @ np.linalg.inv(L), value


def _log_sum(values: Array, axis: int) -> Array:
    return np.asarray(np.logaddexp.reduce(values, axis=axis))
