"""Drives simulated by the very model that filters them."""

import numpy as np

from visfuse_cli.maths import gaussian, motion
from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.records import Gaussian

WHEELBASE = 2.5


def stacked(beliefs: list[Gaussian]) -> Gaussian:
    return Gaussian(np.stack([b.mean for b in beliefs]), np.stack([b.cov for b in beliefs]))


def bicycle_run(rng: np.random.Generator, runs: int, steps: int, dt: float):
    """Model-matched drives of many cars, filtered together: truth, filtered, predicted (T, runs, ...), F."""
    sa, ss, sigma = 1.0, 0.1, np.array([0.1, 0.1, 0.03])
    H = motion.BICYCLE_MEASUREMENT
    P0 = np.diag([0.2, 0.2, 0.5, 0.05, 0.05]) ** 2
    x = np.array([0, 0, 8, 3.0, 0]) + rng.normal(size=(runs, 5)) @ np.sqrt(P0)
    prior = Gaussian(np.broadcast_to([0, 0, 8, 3.0, 0], (runs, 5)), np.broadcast_to(P0, (runs, 5, 5)))
    truth, filtered, predicted, Fs = [], [], [], []
    F = np.broadcast_to(np.eye(5), (runs, 5, 5))
    for k in range(steps):
        if k:
            root = np.linalg.cholesky(motion.bicycle_noise(x, dt, WHEELBASE, sa, ss) + 1e-18 * np.eye(5))
            x = motion.bicycle(x, dt, WHEELBASE)[0] + gaussian.times(root, rng.normal(size=(runs, 5)))
            ahead, F = motion.bicycle(filtered[-1].mean, dt, WHEELBASE)
            Q = motion.bicycle_noise(filtered[-1].mean, dt, WHEELBASE, sa, ss)
            prior = Gaussian(ahead, gaussian.propagate(filtered[-1].cov, F, Q))
        z = x[:, [0, 1, 3]] + sigma * rng.normal(size=(runs, 3))
        residual = wrap_at(z - prior.mean[:, [0, 1, 3]], (2,))
        predicted.append(prior)
        filtered.append(gaussian.update(prior, residual, H, np.diag(sigma**2))[0])
        Fs.append(F)
        truth.append(x)
    return np.array(truth), stacked(filtered), stacked(predicted), np.array(Fs)
