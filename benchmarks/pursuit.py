"""Bradshaw 1997, section 6: gaze predicted over a latency, by its angles and on the ground; pursuit with it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.bradshaw import THETA, T, course_motions, measured, started
from visfuse_cli.maths import gaussian, gaze, imm, motion
from visfuse_cli.records import Gaussian

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
