"""The motion models of a target in the world, and how they share one state (Jia 2008, sec. 4).

Common state: position (3), velocity (3), acceleration (3), and how far off the centre of its swing it is (3). A model
without a centre thinks the target at its own: zero, with a variance.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from visfuse_cli.maths import imm, motion
from visfuse_cli.maths.gaussian import times
from visfuse_cli.maths.imm import Bank, Step
from visfuse_cli.maths.kept import Banks, smoothed
from visfuse_cli.moving.settings import FilterSettings
from visfuse_cli.records import Array, Gaussian

SIZE = 12
P, V, A = (slice(3 * k, 3 * k + 3) for k in range(3))
SPARE = np.repeat([1.0, 1.0, 1.0, 4.0], 3)  # variances of what a model lacks: (m/s^2)^2 and m^2
OFF_CENTRE = np.kron([[1.0, 0, 0], [0, 1, 0], [1, 0, -1]], np.eye(3))  # from [p, v, centre] to [p, v, p - centre], back
INDEX = {
    "drifting": tuple(range(6)),
    "cv": tuple(range(6)),
    "ca": tuple(range(9)),
    "periodic": (*range(6), *range(9, 12)),
}
INTERVALS = 64  # lengths of a step whose motions are remembered


class Models:
    """The models a configuration asks for."""

    def __init__(self, settings: FilterSettings) -> None:
        self._settings = settings
        self.names = tuple(INDEX) if settings.kind == "imm" else (settings.kind,)
        self._ways = lru_cache(INTERVALS)(self._motions)

    def start(self, position: Gaussian, velocity: Gaussian) -> Bank:
        """Every model from a place (3,) and a velocity (3,), equally likely."""
        mean, cov = np.zeros(SIZE), np.diag(SPARE)
        mean[P], mean[V] = position.mean, velocity.mean
        cov[P, P], cov[V, V] = position.cov, velocity.cov
        return imm.start(Gaussian(mean, cov), len(self.names))

    def predict(self, bank: Bank, dt: float) -> Step:
        """The bank dt (s) later: mixed, then each by its own motion. Jia 2008, eqs. 23-26, 33-34."""
        F, Q = self._ways(dt)
        return imm.predict(bank, self._changes(dt), lambda x: (times(F, x), F, Q))

    def kept(self, first: Bank) -> Banks:
        """Where a target's banks are kept, its first one in it."""
        return Banks(first, np.array([np.isin(range(SIZE), INDEX[name]) for name in self.names]))

    def smoothed(self, banks: Banks, t: Array) -> Iterator[Bank]:
        """The bank of every instant t (T,) s given these T, the last first."""
        return smoothed(banks, t, self.predict, self._changes)

    def _changes(self, dt: float) -> Array:
        return imm.changes(len(self.names), dt, self._settings.sojourn)

    def _motions(self, dt: float) -> tuple[Array, Array]:
        """F and Q (r, N, N) of all models over dt (s)."""
        motions = [imm.embedded(*self._motion(name, dt), INDEX[name], SPARE) for name in self.names]
        F, Q = (np.stack(part) for part in zip(*motions, strict=True))
        F.flags.writeable = Q.flags.writeable = False
        return F, Q

    def _motion(self, name: str, dt: float) -> tuple[Array, Array]:
        s = self._settings
        if name == "drifting":
            return motion.drifting_point(dt, 3), motion.drifting_point_noise(dt, s.q_drifting, 0.25, 3)
        if name == "cv":
            return motion.constant_velocity(dt, 3), motion.constant_velocity_noise(dt, s.q_cv, 3)
        if name == "ca":
            return motion.constant_acceleration(dt, 3), motion.constant_acceleration_noise(dt, s.q_ca, 3)
        noise = motion.periodic_noise(dt, s.omega, s.q_periodic, 0.01, 3)
        return OFF_CENTRE @ motion.periodic(dt, s.omega, 3, s.euler) @ OFF_CENTRE, OFF_CENTRE @ noise @ OFF_CENTRE.T
