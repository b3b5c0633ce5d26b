"""The motion models of a target in the world, and how they share one state (Jia 2008, sec. 4).

Common state: position (3), velocity (3), acceleration (3), centre of a periodic motion (3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from visfuse_cli.maths import gaussian, imm, motion
from visfuse_cli.maths.imm import Extension
from visfuse_cli.moving.settings import FilterSettings
from visfuse_cli.records import Array, Gaussian

SIZE = 12
P, V, A, C = (slice(3 * k, 3 * k + 3) for k in range(4))
SPARE = np.repeat(
    [1.0, 1.0, 1.0, 4.0], 3
)  # variances of what a model lacks: (m/s^2)^2 of acceleration, m^2 of a centre
INDEX = {
    "drifting": tuple(range(6)),
    "cv": tuple(range(6)),
    "ca": tuple(range(9)),
    "periodic": (*range(6), *range(9, 12)),
}


@dataclass(frozen=True, slots=True)
class Bank:
    """Beliefs of each model, and the models' log probabilities."""

    beliefs: tuple[Gaussian, ...]
    log_mu: Array


@dataclass(frozen=True, slots=True)
class Step:
    """What a backward pass needs of one instant: beliefs mixed, predicted and filtered, F, and log probabilities."""

    mixed: tuple[Gaussian, ...]
    F: tuple[Array, ...]
    predicted: tuple[Gaussian, ...]
    filtered: Bank
    ahead: Array


class Models:
    """The models a configuration asks for."""

    def __init__(self, settings: FilterSettings) -> None:
        self._settings = settings
        self.names = tuple(INDEX) if settings.kind == "imm" else (settings.kind,)
        self.extensions = [Extension(INDEX[name], SPARE) for name in self.names]
        self._log_p = imm.transition(len(self.names), settings.stay)

    def start(self, position: Gaussian, velocity: Array) -> Bank:
        """Every model from a place (3,) and a velocity (3,), equally likely."""
        mean, cov = np.zeros(SIZE), np.diag(SPARE.copy())
        mean[P], mean[V], mean[C] = position.mean, velocity, position.mean
        cov[P, P] = position.cov
        cov[V, V] = self._settings.start_speed**2 * np.eye(3)
        common = Gaussian(mean, cov)
        beliefs = tuple(extension.reduced(common) for extension in self.extensions)
        return Bank(beliefs, np.full(len(self.names), -np.log(len(self.names))))

    def predict(self, bank: Bank, dt: float) -> tuple[Bank, Step]:
        """The bank dt (s) later: mixed, then each by its own motion. Jia 2008, eqs. 23-26, 33-34."""
        mixed, ahead = imm.mix(bank.beliefs, bank.log_mu, self._log_p, self.extensions)
        F = tuple(self._motion(name, dt) for name in self.names)
        noise = [self._noise(name, dt) for name in self.names]
        predicted = tuple(gaussian.predict(b, f, q) for b, f, q in zip(mixed, F, noise, strict=True))
        after = Bank(predicted, ahead)
        return after, Step(tuple(mixed), F, predicted, after, ahead)

    def combined(self, bank: Bank) -> Gaussian:
        """The common belief (12,)."""
        return imm.combined(bank.beliefs, bank.log_mu, self.extensions)

    def _motion(self, name: str, dt: float) -> Array:
        s = self._settings
        if name == "drifting":
            return motion.drifting_point(dt, 3)
        if name == "cv":
            return motion.constant_velocity(dt, 3)
        if name == "ca":
            return motion.constant_acceleration(dt, 3)
        return motion.periodic(dt, s.omega, 3, s.euler)

    def _noise(self, name: str, dt: float) -> Array:
        s = self._settings
        if name == "drifting":
            return motion.drifting_point_noise(dt, s.q_drifting, 0.25, 3)
        if name == "cv":
            return motion.constant_velocity_noise(dt, s.q_cv, 3)
        if name == "ca":
            return motion.constant_acceleration_noise(dt, s.q_ca, 3)
        return motion.periodic_noise(dt, s.omega, s.q_periodic, 0.01, 3) + 1e-12 * np.eye(9)

    def smoothed(self, steps: list[Step]) -> tuple[list[Gaussian], list[Array]]:
        """Common beliefs (12,) and log probabilities (r,) of every instant given all: a backward pass over the bank.

        Each model looks back from the combined estimate after it; with one model this is the Rauch-Tung-Striebel pass.
        """
        last = steps[-1].filtered
        common, log_mu = [self.combined(last)], [last.log_mu]
        for k in range(len(steps) - 2, -1, -1):
            after, now = steps[k + 1], steps[k]
            own = [
                imm.smoothed_once(extension.reduced(common[0]), mixed, predicted, F)
                for extension, mixed, predicted, F in zip(
                    self.extensions, after.mixed, after.predicted, after.F, strict=True
                )
            ]
            # How likely each model was, given which ones came after it.
            joint = self._log_p + (log_mu[0] - after.ahead)[None, :]
            mu = imm.weigh(now.filtered.log_mu, _log_sum(joint))
            common.insert(0, imm.combined(own, log_mu[0], self.extensions))
            log_mu.insert(0, mu)
        return common, log_mu


def _log_sum(values: Array) -> Array:
    top = values.max(axis=1)
    return np.asarray(top + np.log(np.sum(np.exp(values - top[:, None]), axis=1)))
