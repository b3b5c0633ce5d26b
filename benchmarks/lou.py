"""Lou 2002, figs 5 and 7: filters of a car, smooth and in hard manoeuvres."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.bounds import bound
from visfuse_cli.maths import covariance_updating, fading, gaussian, motion
from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.records import Gaussian

T, THETA = 0.04, (3,)  # s, the heading
WHEELBASE = 2.5
POSE_NOISE = np.diag([0.1, 0.1, np.deg2rad(2)]) ** 2
TOLD = 25  # frames that the noise first told counts for, where it adapts itself
LEAST_PROCESS = np.array([1e-6, 1e-6, 1e-6, 1e-8, 1e-8])
CARS = ("ekf", "cuf", "fading", "fading-adapted", "fading-cuf")


def drives() -> dict[str, np.ndarray]:
    """True states (200, 5) at 25 fps: a circle; fig 4 (reverses, stops, turns right, speeds up); fig 6 (slow, hard
    acceleration, a right turn, a stop)."""
    t = np.arange(200) * T

    def during(start: float, end: float, value: float) -> np.ndarray:
        return np.where((t >= start) & (t < end), value, 0.0)

    def drive(pull: np.ndarray, steer: np.ndarray, speed: float, phi: float = 0.0) -> np.ndarray:
        states = [np.array([0, 0, speed, 0.3, phi])]
        for a, b in zip(pull[:-1], steer[:-1], strict=True):
            x = states[-1]
            for _ in range(10):
                x = motion.bicycle(x + np.array([0, 0, a, 0, b]) * T / 10, T / 10, WHEELBASE)[0]
            states.append(x)
        return np.array(states)

    return {
        "smooth": drive(0 * t, 0 * t, 8.0, 0.1),
        "fig 4": drive(during(2, 5.5, 3), during(2.8, 3.4, -0.9) + during(5, 5.6, 0.9), -3.0),
        "fig 6": drive(during(2, 3.6, 4) - during(5, 7, 4), during(2.6, 3.2, -0.8) + during(4.2, 4.8, 0.8), 2.0),
    }


def cars(runs: int) -> None:
    """Figs 5 and 7: heading predicted one frame ahead, peak over time of the RMS over runs, and position RMS."""
    print("Lou 2002, figs 5 and 7: noise 0.1 m and 2 degrees at 25 fps; predicted one frame ahead")
    print(
        "heading, peak over time of the RMS over runs (degrees) | position RMS (m); the bound is of drives by the model"
    )
    print(f"{'':<34}" + "".join(f"{kind:>18}" for kind in (*CARS, "bound")))
    root = np.sqrt(T)  # a and b held over a frame, as the paper's white noise
    tunings = {
        "1 m/s^2, 0.1 rad/s a frame": (1.0 * root, 0.1 * root, 0.1),
        "1 m/s^2, 0.1 rad/s per root Hz": (1.0, 0.1, 1.0),
        "tuned for the manoeuvre": (3.0, 0.6, 3.0),
    }
    for tuning, sigmas in tunings.items():
        print(tuning)
        for name, path in drives().items():
            row = [*(_drive_errors(path, kind, sigmas, runs) for kind in CARS), _bound(path, *sigmas[:2])]
            print(f"  {name:<32}" + "".join(f"{h:10.2f} |{p:6.3f}" for h, p in row))
    print("(bound: of drives that steer and accelerate by as much white noise as the EKF is told)")


def _bound(path: np.ndarray, sigma_a: float, sigma_steer: float) -> tuple[float, float]:
    """The posterior Cramer-Rao bounds of both columns, were the drive one of those that the EKF's noise stands for."""
    F = [motion.bicycle(x, T, WHEELBASE)[1] for x in np.concatenate([path[:1], path[:-1]])]
    Q = [motion.bicycle_noise(x, T, WHEELBASE, sigma_a, sigma_steer) for x in np.concatenate([path[:1], path[:-1]])]
    P0 = np.diag([0.1, 0.1, 0.5, 0.05, 0.05]) ** 2
    before, _ = bound(P0, F, Q, [motion.BICYCLE_MEASUREMENT] * len(path), POSE_NOISE)
    before = before[11:]
    position = np.sqrt(np.mean(np.trace(before[:, :2, :2], axis1=1, axis2=2)))
    return float(np.rad2deg(np.sqrt(before[:, 3, 3].max()))), float(position)


def _drive_errors(path: np.ndarray, kind: str, sigmas: tuple[float, float, float], runs: int) -> tuple[float, float]:
    size = 6 if "cuf" in kind else 5
    limit = fading.LIMIT if "fading" in kind else 1.0
    rng = np.random.default_rng(1)
    z = path[:, None, [0, 1, 3]] + rng.normal(size=(len(path), runs, 3)) @ np.sqrt(POSE_NOISE)
    P0 = np.diag([0.1, 0.1, 0.5, 0.05, 0.05, 0.5][:size]) ** 2
    mean = np.append(path[0], 0.0)[:size] + rng.normal(size=(runs, size)) @ np.sqrt(P0)
    belief, H = Gaussian(mean, np.broadcast_to(P0, (runs, size, size))), np.eye(size)[[0, 1, 3]]
    R = np.broadcast_to(POSE_NOISE, (runs, 3, 3))
    floors = (LEAST_PROCESS[:size], np.diag(POSE_NOISE))
    memory, noise, errors = None, None, []
    for truth, seen in zip(path[1:], z[1:], strict=True):
        mean, F, Q = _moved(belief, size, sigmas)
        if kind == "fading-adapted":
            noise = noise or fading.AdaptiveNoise(Q, R, TOLD)
            Q, R = noise.Q, noise.R
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        memory = memory or fading.start(ahead, H, R)
        step = fading.update(ahead, Q, wrap_at(seen - mean[:, [0, 1, 3]], (2,)), H, R, memory, limit=limit)
        belief, memory = Gaussian(wrap_at(step.posterior.mean, THETA), step.posterior.cov), step.state
        if noise is not None:  # sec. 3.5
            after = wrap_at(seen - belief.mean[:, [0, 1, 3]], (2,))
            noise = fading.adapt_noise(noise, belief, after, wrap_at(belief.mean - mean, THETA), H, floors)
        errors.append(wrap_at(mean[:, :5] - truth, THETA))
    off = np.array(errors)[10:]
    peak = np.sqrt(np.mean(off[..., 3] ** 2, axis=1)).max()
    return float(np.rad2deg(peak)), float(np.sqrt(np.mean(np.sum(off[..., :2] ** 2, axis=-1))))


def _moved(belief: Gaussian, size: int, sigmas: tuple[float, float, float]) -> tuple[np.ndarray, ...]:
    """Mean, F and Q of the next frame, with (6) or without (5) the acceleration in the state."""
    sigma_a, sigma_steer, sigma_jerk = sigmas
    if size == 6:
        return covariance_updating.advance(belief.mean, belief.cov, T, WHEELBASE, sigma_steer, sigma_jerk)
    Q = motion.bicycle_noise(belief.mean, T, WHEELBASE, sigma_a, sigma_steer)
    return *motion.bicycle(belief.mean, T, WHEELBASE), Q
