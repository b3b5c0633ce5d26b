"""Jia 2008, figs 12-15: four motion models, and all of them interacting, on walks straight and turning."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.bounds import bound
from visfuse_cli.maths import imm, motion
from visfuse_cli.moving.models import SIZE, Models
from visfuse_cli.moving.settings import FilterSettings
from visfuse_cli.records import Gaussian


def people_straight_and_turning(runs: int) -> None:
    """Figs 12-15: a person at 1.2 m/s, 15 Hz, straight or with a turn of 90 degrees in a second; 20 runs, causal."""
    runs = min(runs, 20)
    kinds = ("imm", "drifting", "cv", "ca", "periodic")
    for sigma in (0.03, 0.1):
        print(f"Jia 2008, figs 12-15: position noise {sigma:g} m, {runs} runs; RMS of position (m) | velocity (m/s)")
        print(f"{'':<30}" + "".join(f"{kind:>17}" for kind in (*kinds, "bound")))
        for q in (0.001, 0.01, 0.1, 1.0):
            for turns in (False, True):
                row = [_walk(kind, turns, sigma, q, runs) for kind in kinds]
                name = f"{'straight, turn' if turns else 'straight'}, q_cv {q:g}"
                print(f"{name:<30}" + "".join(f"{p:9.4f} |{v:6.3f}" for p, v in row) + f"{_bound(sigma, q):9.4f}")
        print("(bound: of walks that wander by q_cv; a straight one wanders less, and a turn is none of them)\n")


def _walk(kind: str, turns: bool, sigma: float, q: float, runs: int) -> tuple[float, float]:
    dt, steps = 1 / 15, 90
    rate = np.zeros(steps)
    rate[40:55] = np.pi / 2 * turns
    theta = np.cumsum(rate) * dt
    velocity = 1.2 * np.column_stack([np.cos(theta), np.zeros(steps), np.sin(theta)])
    place = np.cumsum(velocity * dt, axis=0)
    settings = FilterSettings(kind=kind, q_cv=q)
    models = Models(settings)
    H, R = np.eye(3, SIZE), sigma**2 * np.eye(3)
    rng = np.random.default_rng(0)
    z = place[:, None] + sigma * rng.normal(size=(steps, runs, 3))
    bank = models.start(Gaussian(z[0, 0], R), Gaussian(np.zeros(3), settings.start_speed**2 * np.eye(3)))
    beliefs = bank.beliefs
    bank = imm.Bank(
        Gaussian(np.tile(beliefs.mean, (runs, 1, 1)), np.tile(beliefs.cov, (runs, 1, 1, 1))),
        np.tile(bank.log_mu, (runs, 1)),
    )
    bank.beliefs.mean[:, :, :3] = z[0][:, None]
    errors = []
    for k in range(1, steps):
        step = models.predict(bank, dt)
        step, _ = imm.update(step, z[k][:, None] - step.predicted.mean[..., :3], H, R)
        bank = step.filtered
        errors.append(imm.combined(bank).mean[:, :6] - np.concatenate([place[k], velocity[k]]))
    off = np.array(errors)[10:]
    return tuple(float(np.sqrt(np.mean(np.sum(part**2, axis=-1)))) for part in (off[..., :3], off[..., 3:]))  # type: ignore[return-value]


def _bound(sigma: float, q: float) -> float:
    """Posterior Cramer-Rao bound of the position, m RMS in 3D, of walks by constant velocity with density q."""
    F, Q = motion.constant_velocity(1 / 15, 3), motion.constant_velocity_noise(1 / 15, q, 3)
    P0 = np.diag([sigma**2] * 3 + [1.5**2] * 3)
    _, after = bound(P0, [F] * 90, [Q] * 90, [np.eye(3, 6)] * 90, sigma**2 * np.eye(3))
    return float(np.sqrt(np.mean(np.trace(after[11:, :3, :3], axis1=1, axis2=2))))
