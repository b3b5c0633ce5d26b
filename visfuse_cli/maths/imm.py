"""Interacting multiple models: filters of several motions that share what they have in common (Jia 2008, sec. 4).

Each model has a state of its own size. What two models share is told by `Extension`: the components of the common,
longest state that a model holds, and the variance it grants to those that it does not, so that mixing a short state
into a long one never claims to know what it does not. Probabilities are logs throughout. All is batched over leading
axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.maths.gaussian import symmetrise, transpose
from visfuse_cli.records import Array, Gaussian


@dataclass(frozen=True, slots=True)
class Extension:
    """Where a model's components (n,) lie in the common state of size N, and the variances (N,) of those it lacks."""

    index: tuple[int, ...]
    variance: Array

    def extended(self, belief: Gaussian) -> Gaussian:
        """The belief (..., n) as one of the common state (..., N); what is not held is zero, with its variance."""
        size = len(self.variance)
        held = np.zeros(size, dtype=bool)
        held[list(self.index)] = True
        mean = np.zeros((*belief.mean.shape[:-1], size))
        mean[..., self.index] = belief.mean
        cov = np.broadcast_to(np.diag(np.where(held, 0.0, self.variance)), (*mean.shape, size)).copy()
        cov[..., np.array(self.index)[:, None], np.array(self.index)] = belief.cov
        return Gaussian(mean, cov)

    def reduced(self, belief: Gaussian) -> Gaussian:
        """What the model keeps (..., n) of a belief of the common state (..., N)."""
        index = np.array(self.index)
        return Gaussian(belief.mean[..., index], belief.cov[..., index[:, None], index])


def transition(models: int, stay: float) -> Array:
    """log p_ij (r, r), from model i to model j: `stay` on the diagonal, the rest shared. Jia 2008, eq. 37."""
    p = np.full((models, models), (1 - stay) / max(models - 1, 1))
    np.fill_diagonal(p, stay if models > 1 else 1.0)
    return np.log(p)


def mix(
    beliefs: Sequence[Gaussian],
    log_mu: Array,
    log_p: Array,
    extensions: Sequence[Extension],
    angles: tuple[int, ...] = (),
) -> tuple[list[Gaussian], Array]:
    """Each model's own starting point, and the models' log probabilities ahead (..., r). Jia 2008, eqs. 23-26.

    log_mu (..., r) before the step; `angles` are components of the common state on the circle. Bradshaw 1997, sec. 5.
    """
    joint = log_p + log_mu[..., :, None]  # p_ij mu_i: (..., i, j)
    ahead = _log_sum(joint, axis=-2)  # c_j = sum_i p_ij mu_i: Jia 2008, eq. 23
    share = np.exp(joint - ahead[..., None, :])  # mu_i|j: Jia 2008, eq. 24
    common = [extension.extended(belief) for extension, belief in zip(extensions, beliefs, strict=True)]
    mean = np.stack([belief.mean for belief in common], axis=-2)  # (..., i, N)
    cov = np.stack([belief.cov for belief in common], axis=-3)
    mixed = []
    for j, extension in enumerate(extensions):
        weight = share[..., j]
        mixed.append(extension.reduced(_matched(mean, cov, weight, angles, j)))
    return mixed, ahead


def _matched(mean: Array, cov: Array, weight: Array, angles: tuple[int, ...], about: int) -> Gaussian:
    """The Gaussian (..., N) with the first two moments of a mixture, angles taken about component `about`."""
    off = wrap_at(mean - mean[..., about : about + 1, :], angles)
    shift = np.einsum("...i,...in->...n", weight, off)
    apart = off - shift[..., None, :]
    spread = cov + apart[..., :, None] * apart[..., None, :]  # an outer product: Jia 2008, eq. 26
    middle = wrap_at(mean[..., about, :] + shift, angles)
    return Gaussian(middle, symmetrise(np.einsum("...i,...inm->...nm", weight, spread)))


def weigh(ahead: Array, log_likelihood: Array) -> Array:
    """The models' log probabilities (..., r) after a measurement. Jia 2008, eqs. 28-29, the sum over j."""
    total = ahead + log_likelihood
    return np.asarray(total - _log_sum(total, axis=-1)[..., None])


def combined(
    beliefs: Sequence[Gaussian], log_mu: Array, extensions: Sequence[Extension], angles: tuple[int, ...] = ()
) -> Gaussian:
    """One belief of the common state (..., N). Jia 2008, eqs. 30-31."""
    common = [extension.extended(belief) for extension, belief in zip(extensions, beliefs, strict=True)]
    mean = np.stack([belief.mean for belief in common], axis=-2)
    cov = np.stack([belief.cov for belief in common], axis=-3)
    return _matched(mean, cov, np.exp(log_mu), angles, 0)


def smoothed_once(later: Gaussian, filtered: Gaussian, predicted: Gaussian, F: Array) -> Gaussian:
    """One backward step (..., n) of a single model, from its smoothed successor."""
    gain = transpose(np.linalg.solve(predicted.cov, F @ filtered.cov))
    mean = filtered.mean + (gain @ (later.mean - predicted.mean)[..., None])[..., 0]
    cov = filtered.cov + gain @ (later.cov - predicted.cov) @ transpose(gain)
    return Gaussian(mean, symmetrise(cov))


def _log_sum(values: Array, axis: int) -> Array:
    top = np.max(values, axis=axis, keepdims=True)
    return np.asarray(np.squeeze(top, axis) + np.log(np.sum(np.exp(values - top), axis=axis)))
