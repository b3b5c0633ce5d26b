"""The motions by speed and course that interact on the ground (Bradshaw 1997, secs. 4.1 and 5)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from visfuse_cli.maths import course, imm
from visfuse_cli.maths.imm import Bank, Step
from visfuse_cli.maths.kept import Banks, smoothed
from visfuse_cli.moving.settings import FilterSettings
from visfuse_cli.records import Array, Gaussian

KINDS = {"csd": course.CSD, "cs": course.CS, "cd": course.CD}
SPARE = (0.3, 0.3)  # variances of the rates of speed (m/s^2)^2 and of course (rad/s)^2 that a motion lacks


class Courses:
    """The motions that a configuration asks for, in the state [X, Y, s, theta, s', theta']."""

    def __init__(self, settings: FilterSettings) -> None:
        self.names = tuple(KINDS) if settings.kind == "imm" else (settings.kind,)
        speed, way = settings.sigma_speed**2, settings.sigma_course**2
        densities = {
            "csd": (speed, way),
            "cs": (speed, settings.sigma_turn**2),
            "cd": (settings.sigma_pull**2, way),
        }
        self._motions = [(KINDS[name], *densities[name]) for name in self.names]
        self._sojourn = settings.sojourn

    def start(self, place: Gaussian, velocity: Gaussian) -> Bank:
        """Every motion from a place (2,) and a velocity (2,), equally likely."""
        speed = max(float(np.linalg.norm(velocity.mean)), 1e-3)
        along = velocity.mean / speed
        across = np.array([-along[1], along[0]])
        mean = np.array([*place.mean, speed, np.arctan2(along[1], along[0]), 0.0, 0.0])
        cov = np.zeros((6, 6))
        cov[:2, :2] = place.cov
        cov[2, 2] = along @ velocity.cov @ along
        cov[3, 3] = min(across @ velocity.cov @ across / speed**2, 1.0)
        cov[4, 4], cov[5, 5] = SPARE
        return imm.start(Gaussian(mean, cov), len(self.names))

    def predict(self, bank: Bank, dt: float) -> Step:
        """The bank dt (s) later: mixed, then each by its own motion."""

        def advance(x: Array) -> tuple[Array, Array, Array]:
            moved, F, Q = [], [], []
            for k, (kind, speed, turn) in enumerate(self._motions):
                mean, way = course.advance(x[..., k, :], np.array(dt), kind)
                moved.append(mean)
                F.append(way)
                Q.append(course.noise(x[..., k, :], np.array(dt), kind, speed, turn, SPARE))
            return np.stack(moved, axis=-2), np.stack(F, axis=-3), np.stack(Q, axis=-3)

        return imm.predict(bank, self._changes(dt), advance, course.ANGLES)

    def kept(self, first: Bank) -> Banks:
        """Where a target's banks are kept, its first one in it."""
        return Banks(first, np.ones(first.beliefs.mean.shape, bool))

    def smoothed(self, banks: Banks, t: Array) -> Iterator[Bank]:
        """The bank of every instant t (T,) s given these T, the last first."""
        return smoothed(banks, t, self.predict, self._changes, course.ANGLES)

    def _changes(self, dt: float) -> Array:
        return imm.changes(len(self.names), dt, self._sojourn)


def combined(bank: Bank) -> Gaussian:
    """One belief of [X, Y, s, theta, s', theta']."""
    return imm.combined(bank, course.ANGLES)
