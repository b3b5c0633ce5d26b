"""Bradshaw 1997, table 1 and figs 9-12: motions by speed and course on a rounded square and on a walk that turns."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.bounds import bound
from visfuse_cli.maths import course, gaussian, imm
from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.records import Gaussian

T = 0.04  # s
COURSES = (course.CSD, course.CS, course.CD)
THETA = (3,)


def course_motions(speed: float, straight: float, turn: float, pull: float) -> Callable[..., tuple]:
    """The three motions: variances a second of s', theta' (straight), theta'' (turn) and s'' (pull)."""
    densities = ((speed, straight), (speed, turn), (pull, straight))

    def advance(x: np.ndarray, dt: float = T) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        parts = [course.advance(x[..., k, :], np.array(dt), kind) for k, kind in enumerate(COURSES)]
        noise = [
            course.noise(x[..., k, :], np.array(dt), kind, *densities[k], (0.1, 0.1)) for k, kind in enumerate(COURSES)
        ]
        return np.stack([m for m, _ in parts], -2), np.stack([F for _, F in parts], -3), np.stack(noise, -3)

    return advance


def started(z: np.ndarray, R: np.ndarray) -> imm.Bank:
    """A bank from measurements (runs, 4) of place and velocity, at ten times their noise."""
    speed = np.hypot(z[:, 2], z[:, 3])
    mean = np.column_stack([z[:, :2], speed, np.arctan2(z[:, 3], z[:, 2]), np.zeros((len(z), 2))])
    cov = np.zeros((len(z), 6, 6))
    along = np.stack([np.cos(mean[:, 3]), np.sin(mean[:, 3])], axis=-1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.maximum(speed, 0.1)[:, None]
    turn = np.stack([along, across], axis=1)
    cov[:, :2, :2] = 10 * R[..., :2, :2]
    cov[:, 2:4, 2:4] = 10 * turn @ R[..., 2:, 2:] @ np.swapaxes(turn, 1, 2)
    cov[:, 4, 4], cov[:, 5, 5] = 0.1, 0.3
    return imm.start(Gaussian(mean, cov), len(COURSES))


def measured(step: imm.Step, z: np.ndarray, R: np.ndarray) -> imm.Step:
    expected, H = course.observe(step.predicted.mean)
    return imm.update(step, z[:, None] - expected, H, R)[0]


R = np.diag([0.1, 0.1, 1.5, 1.5]) / 10
RATE = np.tile(np.r_[np.zeros(50), np.full(50, np.pi / 4)], 4)  # rad/s: straight, and 45 degrees a second


def tables(runs: int) -> None:
    rounded_square(runs)
    promptness(runs)
    alone(runs)
    switching(runs)


def square() -> np.ndarray:
    """True states (400, 6) at 5 m/s: 50 steps straight, 50 turning, four times."""
    truth = [np.array([0.0, 0, 5, 0, 0, 0])]
    for w in RATE[1:]:
        truth.append(course.advance(np.append(truth[-1][:5], w), np.array(T), course.CS)[0])
    return np.array(truth)


def seen(truth: np.ndarray, noise: np.ndarray, runs: int) -> np.ndarray:
    """Measurements (T, runs, 4) of place and velocity."""
    rng = np.random.default_rng(0)
    return course.observe(truth)[0][:, None] + rng.normal(size=(len(truth), runs, 4)) * np.sqrt(np.diag(noise))


def interacting(z: np.ndarray, noise: np.ndarray, stay: float, densities: tuple[float, ...]) -> list[imm.Step]:
    """Every instant's step of the three motions that interact, over measurements (T, runs, 4)."""
    advance, log_p = course_motions(*densities), imm.transition(3, stay)
    bank, steps = started(z[0], noise), []
    for each in z[1:]:
        steps.append(measured(imm.predict(bank, log_p, advance, THETA), each, noise))
        bank = steps[-1].filtered
    return steps


PAPERS = (0.1 * T, 1e-3, 30 * T, 0.1 * T)  # sigma_s' 0.1, sigma_theta'' 30: held over a step, as densities


def rounded_square(runs: int) -> None:
    """Table 1 and fig 12: when the motion changes, and the rate of turn."""
    steps = interacting(seen(square(), R, runs), R, 0.96, PAPERS)
    causal = np.stack([imm.combined(step.filtered, THETA).mean[:, 5] for step in steps])
    later = imm.smooth(steps, imm.transition(3, 0.96), THETA)
    smooth = np.stack([imm.combined(bank, THETA).mean[:, 5] for bank in later])
    turning = RATE[1:] > 0
    print("Bradshaw 1997, table 1 and fig 12: rounded square at 5 m/s, 45 degrees/s, T = 0.04 s, noise R / 10")
    columns = ("median", "within 4", "within 10", "worst", "spurious", "rate in turns", "rate RMSE")
    print(f"{'switches (steps late)':<28}" + "".join(f"{c:>14}" for c in columns))
    print(f"{'the paper, causal':<28}{'9 to 18':>14}{'':>14}{'':>14}{18:>14}{'':>14}{0.547:14.3f}{'-':>14}")
    four = np.array([causal[max(0, k - 3) : k + 1].mean(axis=0) for k in range(len(causal))])
    for name, rates, margin in (
        ("causal rate", causal, 0.25),
        ("causal, mean of four", four, 0.15),
        ("smoothed rate", smooth, 0.1),
    ):
        late, spurious = _switches(rates, margin)
        row = (np.mean(np.abs(late) <= 4), np.mean(np.abs(late) <= 10))
        off = np.sqrt(np.mean((rates - RATE[1:, None]) ** 2))
        print(
            f"{name:<28}{np.median(np.abs(late)):14.0f}" + "".join(f"{share:14.1%}" for share in row),
            f"{np.abs(late).max():13.0f}{spurious:14.2f}{rates[turning].mean():14.3f}{off:14.3f}",
        )
    print(f"{'bound, switches known':<28}{'':>84}{_known_switches():14.3f}")
    print("(bound: of turns that wander as the filter's noise says, causal; these keep their rate)")
    print("(the true rate is 0.785 rad/s; spurious switches a run; a switch: the rate passes the middle by a margin)\n")


def _known_switches() -> float:
    """The posterior Cramer-Rao bound of the rate of turn, rad/s RMS, were the motion of every step known."""
    truth, kinds = square(), [course.CS if rate > 0 else course.CSD for rate in RATE]
    F, Q, H = [], [], []
    for k, kind in enumerate(kinds):
        before = truth[max(k - 1, 0)]
        F.append(course.advance(before, np.array(T), kind)[1])
        Q.append(
            course.noise(before, np.array(T), kind, PAPERS[0], PAPERS[2] if kind == course.CS else 1e-3, (0.1, 0.3))
        )
        H.append(course.observe(truth[k])[1])
        if kind == course.CSD:  # known to go straight: there is no rate to be found
            Q[-1][5, 5] = 1e-9
        elif kinds[k - 1] != kind:
            Q[-1][5, 5] += 0.3
    _, after = bound(np.diag([0.1, 0.1, 1.5, 0.1, 0.1, 0.3]), F, Q, H, R)
    return float(np.sqrt(np.mean(after[1:, 5, 5])))


def alone_on(z: np.ndarray, noise: np.ndarray, kind: tuple[bool, bool], speed: float, turn: float) -> np.ndarray:
    """States (T, runs, 6) of one motion's extended Kalman filter."""
    bank = started(z[0], noise)
    belief = Gaussian(bank.beliefs.mean[:, 0], bank.beliefs.cov[:, 0])
    states = [belief.mean]
    for each in z[1:]:
        mean, F = course.advance(belief.mean, np.array(T), kind)
        Q = course.noise(belief.mean, np.array(T), kind, speed, turn, (0.1, 0.1))
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        h, H = course.observe(ahead.mean)
        after, _ = gaussian.update(ahead, each - h, H, noise)
        belief = Gaussian(wrap_at(after.mean, THETA), after.cov)
        states.append(belief.mean)
    return np.array(states)


def promptness(runs: int) -> None:
    """Fig 9: the CS filter alone, by its process noise."""
    z = seen(square(), R, runs)
    print("Bradshaw 1997, fig 9: constant speed alone; steps until the mean rate is half-way, its noise once settled")
    for variance in (1, 30, 100):
        rate = alone_on(z, R, course.CS, 0.1 * T, variance * T)[..., 5]
        late = int(np.argmax(rate[50:100].mean(axis=1) > np.pi / 8))
        overshoot = rate[50:100].mean(axis=1).max() - np.pi / 4
        print(
            f"  sigma^2 {variance:>3} rad^2 s^-4: {late:3d} steps, noise {rate[90:100].std(axis=1).mean():.3f} rad/s,"
            f" overshoot {overshoot:.3f} rad/s"
        )
    print("(the paper: with more noise prompter, and noisier)\n")


def alone(runs: int) -> None:
    """Fig 10: each filter alone on a walk that turns sharply to the left."""
    rate = np.r_[np.zeros(80), np.full(50, np.pi / 4), np.zeros(80)]
    truth = [np.array([0.0, 0, 1.4, 0, 0, 0])]
    for w in rate[1:]:
        truth.append(course.advance(np.append(truth[-1][:5], w), np.array(T), course.CS)[0])
    path, walking = np.array(truth), 10 * R
    z = seen(path, walking, runs)
    print("Bradshaw 1997, fig 10: a walk at 1.4 m/s with a sharp left turn; position RMSE, straight and turning (m)")
    rows = {
        name: alone_on(z, walking, kind, 0.1 * T, turn)
        for name, kind, turn in (("CS", course.CS, T), ("CD", course.CD, 1e-3), ("CSD", course.CSD, 1e-3))
    }
    steps = interacting(z, walking, 0.96, (0.1 * T, 1e-3, T, 0.1 * T))
    rows["IMM"] = np.stack([z[0], *[imm.combined(step.filtered, THETA).mean[:, :4] for step in steps]])
    for name, states in rows.items():
        off = np.sum((states[..., :2] - path[:, None, :2]) ** 2, axis=-1)
        print(f"  {name:<6}{np.sqrt(off[20:80].mean()):8.3f}{np.sqrt(off[85:140].mean()):8.3f}")
    print("(the paper: CSD and CD do poorly in the turn, CS well)\n")


def switching(runs: int) -> None:
    """Fig 11: what the probability to stay does to the probability of the right motion."""
    z, turning = seen(square(), R, runs), RATE[1:] > 0
    print("Bradshaw 1997, fig 11: mean probability of CS while turning and while straight, and RMSE of the rate")
    for stay in (0.93, 0.96, 0.99):
        steps = interacting(z, R, stay, PAPERS)
        p = np.exp(np.stack([step.filtered.log_mu[:, 1] for step in steps])).mean(axis=1)
        rate = np.stack([imm.combined(step.filtered, THETA).mean[:, 5] for step in steps])
        off = np.sqrt(np.mean((rate - RATE[1:, None]) ** 2))
        print(f"  stay {stay:.2f}: {p[turning].mean():.3f} {p[~turning].mean():.3f}   {off:.3f} rad/s")
    print("(the paper, table 1 at 0.96: 0.653 and 0.361; more discrimination with a higher probability to stay)")


def _switches(rates: np.ndarray, margin: float) -> tuple[np.ndarray, float]:
    """How late each of the seven switches comes (n,), in steps, and how many more there are a run."""
    due = np.arange(50, 400, 50)
    late, spurious = [], 0
    for rate in rates.T:
        found, on = [], False
        for k, value in enumerate(rate, start=1):
            if value > 0.39 + margin if not on else value < 0.39 - margin:
                on = not on
                found.append(k)
        spurious += max(len(found) - len(due), 0)
        for i, when in enumerate(due):
            same = np.array([k for j, k in enumerate(found) if j % 2 == i % 2] or [np.inf])
            late.append(same[np.argmin(np.abs(same - when))] - when)
    return np.array(late), spurious / rates.shape[1]
