"""Manoeuvres at a crossroads, in the road's frame; traffic keeps to the right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from samples.drives import Phase, manoeuvre
from samples.fleet import clear_of, random_vehicle
from samples.scene import Array, Vehicle

LANE = 1.75
NORTH, EAST, SOUTH, WEST = np.pi / 2, 0.0, -np.pi / 2, np.pi
Manoeuvre = tuple[Array, Array, list[Phase]]


def crossing_traffic(rng: np.random.Generator, middle: float, seconds: float) -> tuple[Vehicle, ...]:
    """Vehicles at a crossroads whose middle is at y = `middle` m, starting in turn, none too near another."""
    times = np.arange(0.0, seconds + 0.1, 0.1)
    vehicles: list[Vehicle] = []
    # the one that reverses takes longest and goes first
    start = -6.0
    for turn in range(max(6, round(seconds / 2.2))):
        pose, path, phases = KINDS[turn % len(KINDS)](rng, middle)
        vehicle = random_vehicle(rng, len(vehicles) + 1, trucks=0.0)
        for delay in np.arange(0.0, 8.0, 0.8):
            drive = manoeuvre(pose, path, phases, vehicle.length, start + float(delay))
            entered = replace(vehicle, trajectory=drive)
            if clear_of(entered, vehicles, times, 0.8):
                vehicles.append(entered)
                break
        start += float(rng.uniform(1.2, 2.6))
    return tuple(vehicles)


def _line(*points: tuple[float, float]) -> Array:
    """A path (n, 2) through the points, a point each half metre, its corners cut by 4 m."""
    knots = [np.array(points[0])]
    for before, at, after in zip(points, points[1:], points[2:], strict=False):
        corner, a, b = np.array(at), np.array(before), np.array(after)
        enter, leave = (corner + 4.0 * (end - corner) / np.linalg.norm(end - corner) for end in (a, b))
        w = np.linspace(0, 1, 9)[:, None]
        knots += list((1 - w) ** 2 * enter + 2 * w * (1 - w) * corner + w**2 * leave)
    knots.append(np.array(points[-1]))
    way = np.array(knots)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    steps = np.arange(0.0, length[-1], 0.5)
    return np.column_stack([np.interp(steps, length, way[:, axis]) for axis in (0, 1)])


def _right(rng: np.random.Generator, middle: float) -> Manoeuvre:
    path = _line((LANE, -20), (LANE, middle - LANE), (70, middle - LANE))
    speed = float(rng.uniform(7, 10))
    slow = (middle - 8) / speed
    return np.array([LANE, -12, NORTH]), path, [Phase(slow, speed), Phase(4, 4.5), Phase(12, speed)]


def _left(rng: np.random.Generator, middle: float) -> Manoeuvre:
    path = _line((-LANE, 110), (-LANE, middle - LANE), (70, middle - LANE))
    speed = float(rng.uniform(8, 11))
    slow = (78 - middle) / speed
    return np.array([-LANE, 90, SOUTH]), path, [Phase(slow, speed), Phase(4.5, 4.5), Phase(12, speed)]


def _wait_and_cross(rng: np.random.Generator, middle: float) -> Manoeuvre:
    y = middle - LANE
    speed = float(rng.uniform(6, 9))
    # brakes at 2.5 m/s2 so as to stand with the middle 10 m before the crossing's middle
    slow = (35 - speed**2 / 5) / speed
    wait = speed / 2.5 + float(rng.uniform(1.5, 3.5))
    return np.array([-45, y, EAST]), _line((-60, y), (80, y)), [Phase(slow, speed), Phase(wait, 0), Phase(15, speed)]


def _to_camera(rng: np.random.Generator, middle: float) -> Manoeuvre:
    path = _line((80, middle + LANE), (-LANE, middle + LANE), (-LANE, -40))
    speed = float(rng.uniform(6, 9))
    return np.array([45, middle + LANE, WEST]), path, [Phase(34 / speed, speed), Phase(4, 4.5), Phase(12, speed)]


def _reverse(rng: np.random.Generator, middle: float) -> Manoeuvre:
    """Passes the crossing, stops, reverses around the corner into the right arm, and drives off to the left."""
    path = _line((80, middle + LANE), (-80, middle + LANE))
    speed = 7.0
    slow = (middle + 27 - speed**2 / 5) / speed
    wait = speed / 2.5 + float(rng.uniform(0.8, 1.4))
    back = [Phase(3.2, -2.5, 0.0), Phase(4.5, -2.5, -0.35), Phase(1.6, 0, 0.0)]
    return np.array([LANE, -12, NORTH]), path, [Phase(slow, speed, 0.0), Phase(wait, 0, 0.0), *back, Phase(14, speed)]


KINDS: tuple[Callable[[np.random.Generator, float], Manoeuvre], ...] = (
    _reverse,
    _right,
    _wait_and_cross,
    _left,
    _to_camera,
)
