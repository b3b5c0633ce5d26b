"""Time of one filter step a track against FilterPy and Stone Soup: `python benchmarks/filters.py`.

One thread, all sides in turn in the same run, CPU time, the median of fifteen. The others step their tracks one after
the other: their time a track does not depend on how many there are. `pip install filterpy stonesoup`; where one has no
such filter it is left out. The smoother runs over 50 steps, resampling over 1000 particles.
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

from benchmarks import rival_filters
from benchmarks.rival_filters import Step
from visfuse_cli.maths import course, covariance_updating, fading, gaussian, imm, motion, particles, smoothing
from visfuse_cli.moving.models import Models
from visfuse_cli.moving.settings import FilterSettings
from visfuse_cli.records import Gaussian

DT = 0.04
REPEATS = 15
STEPS, PARTICLES = 50, 1000
BLOCK = 128  # tracks in one call: larger arrays come from the system anew each time, page by page
Qs = np.stack([motion.constant_velocity_noise(DT, q, 3) for q in (0.01, 1.0, 10.0)])
F3, H3, R3 = motion.constant_velocity(DT, 3), np.eye(3, 6), 0.04 * np.eye(3)
POSE = np.diag([0.1, 0.1, 0.03]) ** 2


def _people() -> tuple[np.ndarray, np.ndarray]:
    """F and Q (4, 12, 12) of Jia's four motions over DT, as `track-imm` has them."""
    models = Models(FilterSettings())
    step = models.predict(models.start(Gaussian(np.zeros(3), np.eye(3)), Gaussian(np.zeros(3), np.eye(3))), DT)
    return step.F, step.Q


PEOPLE = _people()


def main() -> None:
    rivals: dict[str, dict[str, Step]] = {}
    constants = (F3, Qs, H3, R3)
    for package, make in (
        ("FilterPy", lambda: rival_filters.filterpy(constants, PEOPLE, STEPS, PARTICLES)),
        ("Stone Soup", lambda: rival_filters.stone_soup(constants, DT, STEPS, PARTICLES)),
    ):
        try:
            rivals[package] = make()
        except ImportError:
            print(f"{package} is not installed", file=sys.stderr)
    print(f"{'':<20}{'tracks':>8}{'us a track':>12}" + "".join(f"{name:>12}{'ratio':>8}" for name in rivals))
    for name, make_ours in OURS.items():
        for tracks in (1, 100, 10_000):
            row = _row(make_ours, [own.get(name) for own in rivals.values()], tracks)
            print(f"{name:<20}{tracks:>8}{row}", flush=True)


def _row(make: Callable[[int], Step], others: list[Step | None], tracks: int) -> str:
    """Our time a track, and each rival's with the ratio, us."""
    step = make(min(tracks, BLOCK))
    calls = -(-tracks // BLOCK)  # of a block each
    own, ratios = [], [[] for _ in others]
    for _ in range(REPEATS):
        own.append(clock(step, max(calls, 500 // tracks)) * calls / tracks)
        for other, ratio in zip(others, ratios, strict=True):
            if other is not None:
                ratio.append(clock(other, 20) / own[-1])
    text = f"{statistics.median(own) * 1e6:12.2f}"
    for ratio in ratios:
        middle = statistics.median(ratio) if ratio else 0.0
        text += f"{middle * statistics.median(own) * 1e6:12.1f}{middle:8.1f}" if ratio else f"{'-':>12}{'-':>8}"
    return text


def clock(step: Step, count: int) -> float:
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


def kalman(tracks: int) -> Step:
    belief = beliefs(tracks, np.zeros(6))

    def step() -> None:
        ahead = gaussian.predict(belief, F3, Qs[1])
        gaussian.update(ahead, 0.1 - ahead.mean[..., :3], H3, R3)

    return step


def interacting(tracks: int) -> Step:
    return _interacting(tracks, np.stack([F3] * 3), Qs)


def people(tracks: int) -> Step:
    return _interacting(tracks, *PEOPLE)


def _interacting(tracks: int, F: np.ndarray, Q: np.ndarray) -> Step:
    models, size = F.shape[:2]
    bank, log_p = imm.start(beliefs(tracks, np.zeros(size)), models), imm.transition(models, 0.95)
    H, z = np.eye(3, size), np.full(3, 0.1)

    def step() -> None:
        nonlocal bank
        ahead = imm.predict(bank, log_p, lambda x: (gaussian.times(F, x), F, Q))
        after, _ = imm.update(ahead, z - ahead.predicted.mean[..., :3], H, R3)
        bank = after.filtered
        imm.combined(bank)

    return step


def bicycle(tracks: int) -> Step:
    belief = beliefs(tracks, np.array([0, 0, 8.0, 0.3, 0.05]))

    def step() -> None:
        mean, F = motion.bicycle(belief.mean, DT, 2.5)
        Q = motion.bicycle_noise(belief.mean, DT, 2.5, 1.0, 0.1)
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        gaussian.update(ahead, 0.1 + 0 * mean[..., :3], motion.BICYCLE_MEASUREMENT, POSE)

    return step


def faded(tracks: int) -> Step:
    belief = beliefs(tracks, np.array([0, 0, 8.0, 0.3, 0.05]))
    H = motion.BICYCLE_MEASUREMENT
    memory = fading.start(belief, H, POSE)

    def step() -> None:
        mean, F = motion.bicycle(belief.mean, DT, 2.5)
        Q = motion.bicycle_noise(belief.mean, DT, 2.5, 1.0, 0.1)
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        fading.update(ahead, Q, 0.1 + 0 * mean[..., :3], H, POSE, memory)

    return step


def cuf(tracks: int) -> Step:
    belief = beliefs(tracks, np.array([0, 0, 8.0, 0.3, 0.05, 0.5]))
    H = np.eye(6)[[0, 1, 3]]

    def step() -> None:
        mean, F, Q = covariance_updating.advance(belief.mean, belief.cov, DT, 2.5, 0.1, 1.0)
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        gaussian.update(ahead, 0.1 + 0 * mean[..., :3], H, POSE)

    return step


def turning(tracks: int) -> Step:
    belief = beliefs(tracks, np.array([0, 0, 8.0, 0.3, 0, 0.1]))
    H, R = np.eye(2, 6), R3[:2, :2]

    def step() -> None:
        mean, F = course.advance(belief.mean, np.array(DT), course.CS)
        Q = course.noise(belief.mean, np.array(DT), course.CS, 1.0, 0.1, (0.1, 0.1))
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        gaussian.update(ahead, 0.1 - ahead.mean[..., :2], H, R)

    return step


def smoother(tracks: int) -> Step:
    belief, before, after = beliefs(tracks, np.zeros(6)), [], []
    for _ in range(STEPS):
        before.append(gaussian.predict(belief, F3, Qs[1]))
        belief, _ = gaussian.update(before[-1], 0.1 - before[-1].mean[..., :3], H3, R3)
        after.append(belief)
    filtered, predicted = (
        Gaussian(np.stack([b.mean for b in each]), np.stack([b.cov for b in each])) for each in (after, before)
    )
    F = np.broadcast_to(F3, filtered.cov.shape)
    return lambda: smoothing.rauch_tung_striebel(filtered, predicted, F)


def resampling(tracks: int) -> Step:
    rng = np.random.default_rng(0)
    log_weights = np.log(rng.dirichlet(np.ones(PARTICLES), () if tracks == 1 else (tracks,)))
    return lambda: particles.systematic(log_weights, rng)


OURS = {
    "Kalman, 6 states": kalman,
    "IMM, 3 models": interacting,
    "IMM, 4 models": people,
    "EKF, constant speed": turning,
    "EKF, bicycle": bicycle,
    "fading": faded,
    "CUF": cuf,
    "smoother, 50 steps": smoother,
    "resampling": resampling,
}


if __name__ == "__main__":
    main()
