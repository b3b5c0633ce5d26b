"""Trajectories: cruising in a lane, queueing at a light (IDM), turning and reversing (kinematic bicycle)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from samples.scene import Array, Trajectory

STEP = 0.02
ACCELERATION, BRAKING = 1.8, 2.2
HEADWAY, STANDING_GAP = 1.3, 2.2


def cruise(x: float, direction: int, s0: float, speed: float, sway: tuple[float, float, float]) -> Trajectory:
    """Along a lane at x: speed + a sin(w t + phase) m/s with sway (a, w, phase); s0 is y * direction at t = 0."""
    amplitude, w, phase = sway

    def states(t: Array) -> Array:
        s = s0 + speed * t + amplitude / w * (np.cos(phase) - np.cos(w * t + phase))
        v = speed + amplitude * np.sin(w * t + phase)
        still = np.zeros_like(t)
        return np.column_stack([still + x, direction * s, still + direction * np.pi / 2, still, direction * v])

    return states


def sampled(t: Array, position: Array, heading: Array, velocity: Array) -> Trajectory:
    """A drive through samples (n,), (n, 2), (n,), (n, 2): cubic Hermite, so that velocity is the exact derivative.

    Outside of the samples it goes on straight at the end's velocity.
    """
    curve = CubicHermiteSpline(t, position, velocity)
    slope = curve.derivative()

    def states(when: Array) -> Array:
        inside = np.clip(when, t[0], t[-1])
        v = slope(inside)
        return np.column_stack([curve(inside) + v * (when - inside)[:, None], np.interp(inside, t, heading), v])

    return states


def queue(
    x: float,
    direction: int,
    starts: Sequence[float],
    lengths: Sequence[float],
    speeds: Sequence[float],
    stop: float,
    red: tuple[float, float],
    seconds: float,
) -> list[Trajectory]:
    """One lane's vehicles, front to back, that stop at `stop` (m along the lane) while the light is `red` (s, s).

    Intelligent driver model (Treiber 2000, eqs. 2 and 3).
    """
    t = np.arange(0.0, seconds + STEP, STEP)
    s, v = np.array(starts, dtype=float), np.array(speeds, dtype=float)
    wanted, half = v.copy(), np.array(lengths) / 2
    way, speed = [s.copy()], [v.copy()]
    for now in t[:-1]:
        faster = np.maximum(v + _idm(s, v, wanted, half, stop if red[0] <= now < red[1] else None) * STEP, 0.0)
        s, v = s + (v + faster) / 2 * STEP, faster
        way.append(s.copy())
        speed.append(v.copy())
    along, pace = np.array(way) * direction, np.array(speed) * direction
    nil, heading = np.zeros_like(t), np.full_like(t, direction * np.pi / 2)
    return [
        sampled(t, np.column_stack([nil + x, along[:, i]]), heading, np.column_stack([nil, pace[:, i]]))
        for i in range(len(s))
    ]


def _idm(s: Array, v: Array, wanted: Array, half: Array, stop: float | None) -> Array:
    """Accelerations (n,) of vehicles ordered front to back; a red light is a standing vehicle at the line."""
    gap, closing = np.full(len(s), np.inf), v.copy()
    gap[1:], closing[1:] = (s[:-1] - half[:-1]) - (s[1:] + half[1:]), v[1:] - v[:-1]
    if stop is not None:
        to_line = stop + STANDING_GAP - (s + half)
        # who cannot stop any more drives on
        obeys = (to_line > STANDING_GAP) & (v**2 / (2 * 4.0) < to_line) & (to_line < gap)
        gap, closing = np.where(obeys, to_line, gap), np.where(obeys, v, closing)
    desired = STANDING_GAP + np.maximum(HEADWAY * v + v * closing / (2 * np.sqrt(ACCELERATION * BRAKING)), 0.0)
    return np.maximum(ACCELERATION * (1 - (v / wanted) ** 4 - (desired / np.maximum(gap, 0.1)) ** 2), -6.0)


@dataclass(frozen=True, slots=True)
class Phase:
    """A stretch of a manoeuvre: seconds, wanted speed (m/s, negative: reversing), steering (rad) or None: follow."""

    seconds: float
    speed: float
    steer: float | None = None


def manoeuvre(pose: Array, path: Array, phases: Sequence[Phase], length: float, start: float) -> Trajectory:
    """A kinematic bicycle from pose (x, y, theta) at time `start` (Rajamani 2012, sec. 2.2).

    path (n, 2) m is followed by pure pursuit where a phase gives no steering.
    """
    base, (x, y, theta), v, steer = 0.6 * length, pose, phases[0].speed, 0.0
    rows = []
    for phase in phases:
        for _ in range(round(phase.seconds / STEP)):
            slip = np.arctan(np.tan(steer) / 2)
            rows.append((x, y, theta, v * np.cos(theta + slip), v * np.sin(theta + slip)))
            wanted = _pursue(np.array([x, y]), theta, path, base) if phase.steer is None else phase.steer
            steer += np.clip(wanted - steer, -0.8 * STEP, 0.8 * STEP)
            v += np.clip(phase.speed - v, -2.5 * STEP, 2.0 * STEP)
            theta += v * np.cos(slip) * np.tan(steer) / base * STEP
            slip = np.arctan(np.tan(steer) / 2)
            x += (rows[-1][3] + v * np.cos(theta + slip)) / 2 * STEP
            y += (rows[-1][4] + v * np.sin(theta + slip)) / 2 * STEP
    table = np.array(rows, dtype=np.float64)
    return sampled(start + STEP * np.arange(len(table), dtype=np.float64), table[:, :2], table[:, 2], table[:, 3:])


def _pursue(position: Array, theta: float, path: Array, base: float) -> float:
    """The steering angle (rad) towards the path's point 5 m ahead of the rear axle."""
    rear = position - base / 2 * np.array([np.cos(theta), np.sin(theta)])
    nearest = int(np.argmin(np.linalg.norm(path - rear, axis=1)))
    ahead = np.linalg.norm(path[nearest:] - rear, axis=1) >= 5.0
    aim = path[nearest + int(np.argmax(ahead))] if ahead.any() else path[-1] + 5.0 * (path[-1] - path[-2])
    to_aim = aim - rear
    bearing = np.arctan2(to_aim[1], to_aim[0]) - theta
    return float(np.clip(np.arctan2(2 * base * np.sin(bearing), np.linalg.norm(to_aim)), -0.6, 0.6))
