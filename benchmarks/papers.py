"""The papers' own experiments, simulated: `python benchmarks/papers.py [bradshaw latency jia lou wu] [--runs 100]`.

Each table shows the paper's figure, where it prints one, beside ours. Everything is drawn from fixed seeds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.test_fusion import simulate
from visfuse_cli.maths import course, covariance_updating, fading, gaussian, gaze, imm, motion
from visfuse_cli.maths.angles import wrap_at
from visfuse_cli.moving.models import SIZE, Models
from visfuse_cli.moving.settings import FilterSettings
from visfuse_cli.records import Gaussian

T = 0.04  # s
COURSES = (course.CSD, course.CS, course.CD)
THETA = (3,)


def main() -> None:
    tables: dict[str, Callable[[int], None]] = {
        "bradshaw": rounded_square,
        "latency": prediction_over_latency,
        "jia": people_straight_and_turning,
        "lou": cars,
        "wu": cameras,
    }
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", metavar="table", help=f"of {', '.join(tables)}; all without one")
    parser.add_argument("--runs", type=int, default=100)
    args = parser.parse_args()
    unknown = sorted(set(args.tables) - set(tables))
    if unknown:
        parser.error(f"no table {unknown[0]}; there are {', '.join(tables)}")
    for name in args.tables or tables:
        tables[name](args.runs)
        print()


# --- Bradshaw 1997, table 1 and figs 11-12 ---------------------------------------------------------------------------


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


def rounded_square(runs: int) -> None:
    """Table 1: 50 steps straight, 50 at 45 degrees/s, four times, at 5 m/s, noise R / 10."""
    rate = np.tile(np.r_[np.zeros(50), np.full(50, np.pi / 4)], 4)
    truth = [np.array([0.0, 0, 5, 0, 0, 0])]
    for w in rate[1:]:
        truth.append(course.advance(np.append(truth[-1][:5], w), np.array(T), course.CS)[0])
    R = np.diag([0.1, 0.1, 1.5, 1.5]) / 10
    rng = np.random.default_rng(0)
    z = course.observe(np.array(truth))[0][:, None] + rng.normal(size=(len(rate), runs, 4)) * np.sqrt(np.diag(R))
    log_p = imm.transition(3, 0.96)
    advance = course_motions(0.1 * T, 1e-3, 30 * T, 0.1 * T)
    bank = started(z[0], R)
    steps = []
    for seen in z[1:]:
        steps.append(measured(imm.predict(bank, log_p, advance, THETA), seen, R))
        bank = steps[-1].filtered
    causal = np.stack([imm.combined(step.filtered, THETA).mean[:, 5] for step in steps])
    smooth = np.stack([imm.combined(bank, THETA).mean[:, 5] for bank in imm.smooth(steps, log_p, THETA)])
    turning = rate[1:] > 0
    print("Bradshaw 1997, table 1: rounded square at 5 m/s, 45 degrees/s, T = 0.04 s")
    columns = ("median", "within 4", "within 10", "worst", "spurious", "rate in turns")
    print(f"{'switches (steps late)':<28}" + "".join(f"{c:>14}" for c in columns))
    print(f"{'the paper, causal':<28}{'9 to 18':>14}{'':>14}{'':>14}{18:>14}{'':>14}{0.547:14.3f}")
    four = np.array([causal[max(0, k - 3) : k + 1].mean(axis=0) for k in range(len(causal))])
    for name, rates, margin in (
        ("causal rate", causal, 0.25),
        ("causal, mean of four", four, 0.15),
        ("smoothed rate", smooth, 0.1),
    ):
        late, spurious = _switches(rates, margin)
        row = (np.mean(np.abs(late) <= 4), np.mean(np.abs(late) <= 10))
        print(
            f"{name:<28}{np.median(np.abs(late)):14.0f}" + "".join(f"{share:14.1%}" for share in row),
            f"{np.abs(late).max():13.0f}{spurious:14.2f}{rates[turning].mean():14.3f}",
        )
    print("(the true rate is 0.785 rad/s; spurious switches a run; a switch: the rate passes the middle by a margin)")


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


# --- Bradshaw 1997, section 6 ----------------------------------------------------------------------------------------

HEAD = np.array([0.0, -4.0, 2.0])  # m: the pan-tilt head, the oval's middle is the origin
PIXEL, SLIP = 3e-4, 5e-3  # rad of an angle, rad/s of a rate
FOVEA = 6e-3  # rad: half the field within which the target can be measured


def oval(seconds: float, straight: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) and places (T, 2) m on an oval of two straights and two half circles, 1 to 1.5 m/s (circle: 0)."""
    radius = 1.6
    length, bend = straight, np.pi * radius
    way, places, fine = 0.0, [], T / 20
    count = round(seconds / T) * 20
    for k in range(count):
        lap = way % (2 * (length + bend))
        side, u = divmod(lap, length + bend)
        sign = 1 - 2 * side
        if u < length:
            place, speed = (u - length / 2, -radius), 1.0 + 0.5 * np.sin(np.pi * u / length)
        else:
            a = (u - length) / radius
            place, speed = (length / 2 + radius * np.sin(a), -radius * np.cos(a)), 1.0
        if k % 20 == 0:
            places.append((sign * place[0], sign * place[1]))
        way += speed * fine
    return np.arange(len(places)) * T, np.array(places)


def looked(place: np.ndarray) -> np.ndarray:
    """Elevation and vergence (..., 2) rad that look at ground points (..., 2)."""
    right, ahead, up = place[..., 0] - HEAD[0], place[..., 1] - HEAD[1], -HEAD[2]
    e, v = gaze.angles(np.column_stack([(-right / ahead).ravel(), (up / ahead).ravel()]))
    return np.stack([e, v], axis=-1).reshape(place.shape)


def grounded(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ground points (..., 2) under the gaze (..., 2), and the Jacobian (..., 2, 2)."""

    def point(e: np.ndarray) -> np.ndarray:
        plane = gaze.frontal(e[..., 0].ravel(), e[..., 1].ravel()).reshape(e.shape)
        reach = -HEAD[2] / plane[..., 1]
        return np.stack([HEAD[0] - reach * plane[..., 0], HEAD[1] + reach], axis=-1)

    h = 1e-6
    J = np.stack([(point(angles + h * d) - point(angles - h * d)) / (2 * h) for d in np.eye(2)], axis=-1)
    return point(angles), J


@dataclass
class Pursuer:
    """A filter of gaze angles and rates (runs, 2): `see` a measurement or nothing, and `tell` the angles ahead."""

    see: Callable[[np.ndarray | None, np.ndarray | None], None]
    tell: Callable[[float], np.ndarray]


def pursuer_2d(q: float) -> Pursuer:
    """Constant velocity of the angles."""
    F, Q = motion.constant_velocity(T, 2), motion.constant_velocity_noise(T, q, 2)
    R = np.diag([PIXEL, PIXEL, SLIP, SLIP]) ** 2
    belief: list[Gaussian] = []

    def see(z: np.ndarray | None, rate: np.ndarray | None) -> None:
        if not belief:
            assert z is not None
            assert rate is not None
            belief.append(Gaussian(np.concatenate([z, rate], -1), np.broadcast_to(R, (len(z), 4, 4))))
            return
        belief[0] = gaussian.predict(belief[0], F, Q)
        if z is not None and rate is not None:
            belief[0] = gaussian.update(belief[0], np.concatenate([z, rate], -1) - belief[0].mean, np.eye(4), R)[0]

    return Pursuer(see, lambda ahead: belief[0].mean[:, :2] + ahead * belief[0].mean[:, 2:])


def pursuer_3d(turn: float) -> Pursuer:
    """The three motions on the ground, interacting."""
    advance = course_motions(0.01, 1e-3, turn, 0.5)
    log_p = imm.transition(3, 0.96)
    bank: list[imm.Bank] = []

    def see(z: np.ndarray | None, rate: np.ndarray | None) -> None:
        seen, R = None, None
        if z is not None and rate is not None:
            place, J = grounded(z)
            seen = np.concatenate([place, gaussian.times(J, rate)], axis=-1)
            R = np.zeros((len(z), 4, 4))
            spread = J @ np.swapaxes(J, 1, 2)
            R[:, :2, :2], R[:, 2:, 2:] = PIXEL**2 * spread, SLIP**2 * spread
        if not bank:
            assert seen is not None
            assert R is not None
            bank.append(started(seen, R))
            return
        step = imm.predict(bank[0], log_p, advance, THETA)
        if seen is not None and R is not None:
            step = measured(step, seen, R[:, None])
        bank[0] = step.filtered

    def tell(ahead: float) -> np.ndarray:
        step = imm.predict(bank[0], log_p, lambda x: advance(x, ahead), THETA)
        return looked(imm.combined(step.filtered, THETA).mean[:, :2])

    return Pursuer(see, tell)


def prediction_over_latency(runs: int) -> None:
    """Section 6: the gaze predicted over a latency, by its angles (2D) and on the ground (3D); and pursuit with it."""
    runs = max(2, runs // 5)
    print("Bradshaw 1997, section 6: gaze predicted over a latency, mrad RMS; the better of several tunings each")
    print(f"{'path':<26}{'ahead':>8}{'2D':>9}{'3D':>9}{'3D / 2D':>9}")
    for name, straight, every in (("circle", 0.0, 1), ("oval", 2.7, 1), ("oval, every other frame", 2.7, 2)):
        for ahead in (0.1, 0.15, 0.2):
            plane = min(_gaze_error(pursuer_2d(q), straight, ahead, every, runs) for q in (0.01, 0.03, 0.1, 0.3, 1, 3))
            world = min(_gaze_error(pursuer_3d(q), straight, ahead, every, runs) for q in (0.01, 0.1, 1))
            print(f"{name:<26}{ahead * 1000:5.0f} ms{1000 * plane:9.2f}{1000 * world:9.2f}{world / plane:9.2f}")
    print("(the paper: 3D keeps the toy engine on its oval, 2D does not)")
    print("\npursuit of the oval over 28 s, 150 ms latency, a fovea of +-6 mrad: share kept, saccades a run")
    for name, make in (("2D", lambda: pursuer_2d(0.3)), ("3D", lambda: pursuer_3d(0.1))):
        kept, saccades = _pursuit(make, runs)
        print(f"{name:<26}{kept:8.1%}{saccades:8.2f}")


def _gaze_error(pursuer: Pursuer, straight: float, ahead: float, every: int, runs: int) -> float:
    t, place = oval(24.0, straight)
    true = looked(place)
    rate = np.gradient(true, T, axis=0)
    rng = np.random.default_rng(3)
    errors = []
    for k in range(len(t)):
        seen = k % every == 0
        z = true[k] + PIXEL * rng.normal(size=(runs, 2))
        slip = rate[k] + SLIP * rng.normal(size=(runs, 2))
        pursuer.see(z if seen else None, slip if seen else None)
        if k > 25 and t[k] + ahead < t[-1]:
            later = np.stack([np.interp(t[k] + ahead, t, true[:, c]) for c in (0, 1)])
            errors.append(pursuer.tell(ahead) - later)
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=-1))))


def _pursuit(make: Callable[[], Pursuer], runs: int) -> tuple[float, float]:
    """A head that goes where it is told 150 ms ahead: the share of frames with the target inside its fovea."""
    delay = 4  # frames, 160 ms
    t, place = oval(28.0, 2.7)
    true = looked(place)
    rate = np.gradient(true, T, axis=0)
    kept = saccades = 0
    for run in range(runs):
        rng = np.random.default_rng(run)
        pursuer, demands = make(), list(true[: delay + 1])
        for k in range(len(t)):
            on = np.abs(demands[k] - true[k]).max() < FOVEA
            kept += on
            if not on:  # a saccade brings it back: a new look from where it is
                saccades += 1
                pursuer = make()
            z = (true[k] + PIXEL * rng.normal(size=2))[None]
            pursuer.see(z, (rate[k] + SLIP * rng.normal(size=2))[None])
            demands.append(pursuer.tell((delay + 1) * T)[0])
            if not on:
                demands[k + 1 :] = [true[min(k + 1 + n, len(t) - 1)] for n in range(len(demands) - k - 1)]
    return kept / (runs * len(t)), saccades / runs


# --- Jia 2008, figs 12-15 --------------------------------------------------------------------------------------------


def people_straight_and_turning(runs: int) -> None:
    """Figs 12-15: a person at 1.2 m/s, 15 Hz, straight or with a turn of 90 degrees in a second; 20 runs, causal."""
    runs = min(runs, 20)
    kinds = ("imm", "drifting", "cv", "ca", "periodic")
    for sigma in (0.03, 0.1):
        print(f"Jia 2008, figs 12-15: position noise {sigma:g} m, {runs} runs; RMS of position (m) | velocity (m/s)")
        print(f"{'':<30}" + "".join(f"{kind:>17}" for kind in kinds))
        for q in (0.001, 0.01, 0.1, 1.0):
            for turns in (False, True):
                row = [_walk(kind, turns, sigma, q, runs) for kind in kinds]
                name = f"{'straight, turn' if turns else 'straight'}, q_cv {q:g}"
                print(f"{name:<30}" + "".join(f"{p:9.4f} |{v:6.3f}" for p, v in row))
        print(f"{'bound of the Kalman filter, straight, q_cv 0.01':<48}{_bound(sigma):9.4f}\n")


def _walk(kind: str, turns: bool, sigma: float, q: float, runs: int) -> tuple[float, float]:
    dt, steps = 1 / 15, 90
    rate = np.zeros(steps)
    rate[40:55] = np.pi / 2 * turns
    theta = np.cumsum(rate) * dt
    velocity = 1.2 * np.column_stack([np.cos(theta), np.zeros(steps), np.sin(theta)])
    place = np.cumsum(velocity * dt, axis=0)
    models = Models(FilterSettings(kind=kind, q_cv=q))
    H, R = np.eye(3, SIZE), sigma**2 * np.eye(3)
    rng = np.random.default_rng(0)
    z = place[:, None] + sigma * rng.normal(size=(steps, runs, 3))
    bank = models.start(Gaussian(z[0, 0], R), np.zeros(3))
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


def _bound(sigma: float) -> float:
    """Posterior Cramer-Rao bound of the position, m RMS in 3D: the linear filter's own steady covariance."""
    dt = 1 / 15
    F, Q = motion.constant_velocity(dt, 3), motion.constant_velocity_noise(dt, 0.01, 3)
    belief, roots = Gaussian(np.zeros(6), np.eye(6)), []
    for _ in range(90):
        belief = gaussian.predict(belief, F, Q)
        belief, _ = gaussian.update(belief, np.zeros(3), np.eye(3, 6), sigma**2 * np.eye(3))
        roots.append(np.trace(belief.cov[:3, :3]))
    return float(np.sqrt(np.mean(roots[10:])))


# --- Lou 2002, figs 5 and 7 ------------------------------------------------------------------------------------------

WHEELBASE = 2.5
POSE_NOISE = np.diag([0.1, 0.1, np.deg2rad(2)]) ** 2
CARS = ("ekf", "cuf", "fading", "fading-cuf")


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
    print("heading, peak over time of the RMS over runs (degrees) | position RMS (m)")
    print(f"{'':<34}" + "".join(f"{kind:>18}" for kind in CARS))
    root = np.sqrt(T)  # a and b held over a frame, as the paper's white noise
    tunings = {
        "1 m/s^2, 0.1 rad/s a frame": (1.0 * root, 0.1 * root, 1.0),
        "1 m/s^2, 0.1 rad/s per root Hz": (1.0, 0.1, 1.0),
        "tuned for the manoeuvre": (3.0, 0.6, 3.0),
    }
    for tuning, sigmas in tunings.items():
        print(tuning)
        for name, path in drives().items():
            row = [_drive_errors(path, kind, sigmas, runs) for kind in CARS]
            print(f"  {name:<32}" + "".join(f"{h:10.2f} |{p:6.3f}" for h, p in row))


def _drive_errors(path: np.ndarray, kind: str, sigmas: tuple[float, float, float], runs: int) -> tuple[float, float]:
    sigma_a, sigma_steer, sigma_jerk = sigmas
    size = 6 if "cuf" in kind else 5
    limit = fading.LIMIT if "fading" in kind else 1.0
    rng = np.random.default_rng(1)
    z = path[:, None, [0, 1, 3]] + rng.normal(size=(len(path), runs, 3)) @ np.sqrt(POSE_NOISE)
    P0 = np.diag([0.1, 0.1, 0.5, 0.05, 0.05, 0.5][:size]) ** 2
    mean = np.append(path[0], 0.0)[:size] + rng.normal(size=(runs, size)) @ np.sqrt(P0)
    belief, H = Gaussian(mean, np.broadcast_to(P0, (runs, size, size))), np.eye(size)[[0, 1, 3]]
    memory, errors = None, []
    for truth, seen in zip(path[1:], z[1:], strict=True):
        if size == 6:
            mean, F, Q = covariance_updating.advance(belief.mean, belief.cov, T, WHEELBASE, sigma_steer, sigma_jerk)
        else:
            mean, F = motion.bicycle(belief.mean, T, WHEELBASE)
            Q = motion.bicycle_noise(belief.mean, T, WHEELBASE, sigma_a, sigma_steer)
        ahead = Gaussian(mean, gaussian.propagate(belief.cov, F, Q))
        memory = memory or fading.start(ahead, H, POSE_NOISE)
        residual = wrap_at(seen - mean[:, [0, 1, 3]], (2,))
        step = fading.update(ahead, Q, residual, H, POSE_NOISE, memory, limit=limit)
        belief = Gaussian(wrap_at(step.posterior.mean, THETA), step.posterior.cov)
        memory = step.state
        errors.append(wrap_at(mean[:, :5] - truth, THETA))
    off = np.array(errors)[10:]
    peak = np.sqrt(np.mean(off[..., 3] ** 2, axis=1)).max()
    return float(np.rad2deg(peak)), float(np.sqrt(np.mean(np.sum(off[..., :2] ** 2, axis=-1))))


# --- Wu 2010 ---------------------------------------------------------------------------------------------------------


def cameras(runs: int) -> None:
    """The simulation: four cameras, every way of fusing them."""
    methods = ("central", "closed-loop", "naive", "kim", "covariance-intersection")
    found = simulate(list(methods), runs=runs)
    print("Wu 2010: mean squared error as a share of the centralised bound; normalised error squared (6 is right)")
    print(f"{'the paper, closed loop / naive':<32}{4.475 / 4.889:8.3f}")
    for method in methods:
        print(f"{method:<32}{found[method][0] / found['central'][0]:8.3f}{found[method][1]:8.2f}")


if __name__ == "__main__":
    main()
