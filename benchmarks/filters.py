"""Time of one filter step a track against FilterPy: `python benchmarks/filters.py` (needs `pip install filterpy`).

One thread, both sides in turn in the same run, the median of fifteen, CPU time; FilterPy steps its tracks one after the other, so
its time a track does not depend on how many there are. Where FilterPy has no such filter the ratio is left out.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from visfuse_cli.maths import covariance_updating, fading, gaussian, imm, motion
from visfuse_cli.records import Gaussian

DT = 0.04
REPEATS = 15
BLOCK = 200  # tracks in one call: more do not fit the cache
Qs = np.stack([motion.constant_velocity_noise(DT, q, 3) for q in (0.01, 1.0, 10.0)])
F3, H3, R3 = motion.constant_velocity(DT, 3), np.eye(3, 6), 0.04 * np.eye(3)
POSE = np.diag([0.1, 0.1, 0.03]) ** 2


def main() -> None:
    try:
        rivals: dict[str, Callable[[], None]] = {"Kalman, 6 states": rival_kalman(), "IMM, 3 models": rival_imm()}
    except ImportError:
        sys.exit("FilterPy is not installed: pip install filterpy")
    ours = {
        "Kalman, 6 states": kalman,
        "IMM, 3 models": interacting,
        "EKF, bicycle": bicycle,
        "fading": faded,
        "CUF": cuf,
    }
    print(f"{'':<20}{'tracks':>8}{'us a track':>12}{'FilterPy':>10}{'ratio':>8}")
    for name, make in ours.items():
        for tracks in (1, 100, 10_000):
            step, rival = make(min(tracks, BLOCK)), rivals.get(name)
            calls = -(-tracks // BLOCK)  # of a block each
            times, ratios = [], []
            for _ in range(REPEATS):
                own = clock(step, max(calls, 1000 // tracks)) * calls / tracks
                times.append(own)
                if rival is not None:
                    ratios.append(clock(rival, 200) / own)
            beside = f"{statistics.median(times) * statistics.median(ratios) * 1e6:10.1f}" if ratios else f"{'-':>10}"
            ratio = f"{statistics.median(ratios):8.1f}" if ratios else f"{'-':>8}"
            print(f"{name:<20}{tracks:>8}{statistics.median(times) * 1e6:12.2f}{beside}{ratio}", flush=True)


def clock(step: Callable[[], None], count: int) -> float:
    begun = time.process_time()
    for _ in range(count):
        step()
    return (time.process_time() - begun) / count


def beliefs(tracks: int, mean: np.ndarray) -> Gaussian:
    shape = () if tracks == 1 else (tracks,)
    size = len(mean)
    return Gaussian(
        np.tile(mean, (*shape, 1)) if shape else mean, np.broadcast_to(np.eye(size) * 0.1, (*shape, size, size))
    )


def kalman(tracks: int) -> Callable[[], None]:
    belief = beliefs(tracks, np.zeros(6))

    def step() -> None:
        ahead = gaussian.predict(belief, F3, Qs[1])
        gaussian.update(ahead, 0.1 - ahead.mean[..., :3], H3, R3)

    return step


def interacting(tracks: int) -> Callable[[], None]:
    bank, log_p = imm.start(beliefs(tracks, np.zeros(6)), 3), imm.transition(3, 0.95)
    F = np.stack([F3] * 3)

    def step() -> None:
        ahead = imm.predict(bank, log_p, lambda x: (gaussian.times(F, x), F, Qs))
        after, _ = imm.update(ahead, 0.1 - ahead.predicted.mean[..., :3], H3, R3)
        imm.combined(after.filtered)

    return step


def bicycle(tracks: int) -> Callable[[], None]:
    belief = beliefs(tracks, np.array([0, 0, 8.0, 0.3, 0.05]))

    def step() -> None:
        mean, F = motion.bicycle(belief.mean, DT, 2.5)
        Q = motion.bicycle_noise(belief.mean, DT, 2.5, 1.0, 0.1)
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        gaussian.update(ahead, 0.1 + 0 * mean[..., :3], motion.BICYCLE_MEASUREMENT, POSE)

    return step


def faded(tracks: int) -> Callable[[], None]:
    belief = beliefs(tracks, np.array([0, 0, 8.0, 0.3, 0.05]))
    H = motion.BICYCLE_MEASUREMENT
    memory = fading.start(belief, H, POSE)

    def step() -> None:
        mean, F = motion.bicycle(belief.mean, DT, 2.5)
        Q = motion.bicycle_noise(belief.mean, DT, 2.5, 1.0, 0.1)
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        fading.update(ahead, Q, 0.1 + 0 * mean[..., :3], H, POSE, memory)

    return step


def cuf(tracks: int) -> Callable[[], None]:
    belief = beliefs(tracks, np.array([0, 0, 8.0, 0.3, 0.05, 0.5]))
    H = np.eye(6)[[0, 1, 3]]

    def step() -> None:
        mean, F, Q = covariance_updating.advance(belief.mean, belief.cov, DT, 2.5, 0.1, 1.0)
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        gaussian.update(ahead, 0.1 + 0 * mean[..., :3], H, POSE)

    return step


def rival_kalman() -> Callable[[], None]:
    own = _filterpy(Qs[1])
    z = np.full(3, 0.1)

    def step() -> None:
        own.predict()
        own.update(z)

    return step


def rival_imm() -> Callable[[], None]:
    from filterpy.kalman import IMMEstimator

    p = np.exp(imm.transition(3, 0.95))
    bank = IMMEstimator([_filterpy(Q) for Q in Qs], [1 / 3] * 3, p)
    z = np.full(3, 0.1)

    def step() -> None:
        bank.predict()
        bank.update(z)

    return step


def _filterpy(Q: np.ndarray):  # type: ignore[no-untyped-def]
    from filterpy.kalman import KalmanFilter

    own = KalmanFilter(dim_x=6, dim_z=3)
    own.F, own.H, own.R, own.Q = F3, H3, R3, Q
    own.x, own.P = np.zeros(6), 0.1 * np.eye(6)
    return own


if __name__ == "__main__":
    main()
