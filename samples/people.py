"""People in a yard before several cameras: jointed bodies on smooth walks, with all that a test asks for exact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from scipy.interpolate import PchipInterpolator

from samples.scene import Array, Camera

Colour = tuple[float, float, float]
STEP_M = 0.7
"""Metres: length of a step; the limbs swing with the way that is walked."""


@dataclass(frozen=True, slots=True)
class Part:
    """A capsule from a to b (3,) m with radii m, colour BGR."""

    a: Array
    b: Array
    radius_a: float
    radius_b: float
    colour: Colour


@dataclass(frozen=True, slots=True)
class Walker:
    """A person: height m, clothes, and a walk through knots (n, 2) m at times (n,) s."""

    id: int
    height: float
    skin: Colour
    shirt: Colour
    trousers: Colour
    times: Array
    knots: Array
    jointed: bool = True

    def states(self, t: Array) -> Array:
        """x, y, vx, vy (n, 4) at times t (n,)."""
        curve = PchipInterpolator(self.times, self.knots)
        # Pchip stands still where two knots are one; averaging over half a second rounds its corners.
        lags = np.linspace(-0.25, 0.25, 11)
        when = np.clip(t[:, None] + lags, self.times[0], self.times[-1])
        return np.column_stack([curve(when).mean(axis=1), curve.derivative()(when).mean(axis=1)])

    def parts(self, state: Array, heading: float, way: float) -> list[Part]:
        """The body at one state (4,), facing `heading` rad, after `way` m of walk; a pillar where it is not jointed."""
        h = self.height
        pace = min(float(np.hypot(*state[2:])) / 1.2, 1.0)
        swing = 0.32 * pace * np.sin(np.pi * way / STEP_M)
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        left = np.array([-ahead[1], ahead[0], 0.0])
        foot = np.array([state[0], state[1], 0.0])

        def at(forward: float, side: float, up: float) -> Array:
            return np.asarray(foot + forward * ahead + side * left + np.array([0, 0, up]))

        if not self.jointed:
            return [
                Part(at(0, 0, 0.12 * h), at(0, 0, 0.5 * h), 0.12 * h, 0.12 * h, self.trousers),
                Part(at(0, 0, 0.5 * h), at(0, 0, 0.72 * h), 0.12 * h, 0.12 * h, self.shirt),
                Part(at(0, 0, 0.92 * h), at(0, 0, 0.91 * h), 0.08 * h, 0.08 * h, self.skin),
            ]
        hip, shoulder = 0.5 * h, 0.8 * h
        parts = [
            Part(at(0, 0, hip), at(0, 0, shoulder - 0.02 * h), 0.09 * h, 0.1 * h, self.shirt),
            Part(at(0, 0.05 * h, 0.79 * h), at(0, -0.05 * h, 0.79 * h), 0.06 * h, 0.06 * h, self.shirt),
            Part(at(0, 0, 0.935 * h), at(0, 0, 0.925 * h), 0.065 * h, 0.065 * h, self.skin),
        ]
        for side in (1.0, -1.0):
            reach = side * swing * 0.5 * h
            knee = at(0.6 * reach, side * 0.05 * h, 0.27 * h)
            ankle = at(reach, side * 0.05 * h, 0.035 * h)
            parts.append(Part(at(0, side * 0.05 * h, hip), knee, 0.055 * h, 0.042 * h, self.trousers))
            parts.append(Part(knee, ankle, 0.042 * h, 0.032 * h, self.trousers))
            parts.append(Part(ankle, at(reach + 0.08 * h, side * 0.05 * h, 0.02 * h), 0.03 * h, 0.02 * h, (40, 40, 45)))
            hand = at(-0.8 * reach, side * 0.14 * h, 0.46 * h)
            parts.append(Part(at(0, side * 0.115 * h, 0.79 * h), hand, 0.032 * h, 0.026 * h, self.shirt))
            parts.append(Part(hand, hand - [0, 0, 0.03 * h], 0.028 * h, 0.02 * h, self.skin))
        return parts


@dataclass(frozen=True, slots=True)
class Yard:
    """All that determines the footage: cameras by name with their rates (1/s) and delays (s), walkers, light, noise."""

    cameras: dict[str, Camera]
    rates: dict[str, Fraction]
    delays: dict[str, float]
    walkers: tuple[Walker, ...]
    seconds: float
    seed: int
    noise: float = 2.5
    sun: tuple[float, float, float] | None = (0.45, 0.3, 0.84)
    ground_z: float = 0.0
    """Metres: the height of the ground in the world of the calibration."""


def looking_at(centre: Array, target: Array, focal: float, size: tuple[int, int], roll: float = 0.0) -> Camera:
    """A camera at `centre` (3,) m that looks at `target` (3,) m, turned by `roll` rad about its axis."""
    axis = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(axis, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(axis, right)
    c, s = np.cos(roll), np.sin(roll)
    K = np.array([[focal, 0, size[0] / 2 - 0.5], [0, focal, size[1] / 2 - 0.5], [0, 0, 1.0]])
    return Camera(K, np.stack([c * right + s * down, c * down - s * right, axis]), np.asarray(centre, float), size)


def crossing(
    seed: int,
    seconds: float = 12.0,
    people: int = 3,
    cameras: int = 4,
    size: tuple[int, int] = (640, 480),
    fps: Fraction = Fraction(20),
    stand_s: float = 0.0,
    jointed: bool = True,
) -> Yard:
    """People who come from different sides, cross in the middle within a second and go on; cameras all around."""
    rng = np.random.default_rng((seed, 7))
    turn = rng.uniform(0, 2 * np.pi)
    views = {}
    for k in range(cameras):
        angle = turn + 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) / cameras
        far, high = rng.uniform(5.5, 8.0), rng.uniform(2.0, 4.5)
        centre = np.array([far * np.cos(angle), far * np.sin(angle), high])
        # wide enough that a person at the yard's edge stays in the picture
        focal = size[0] / 2 / np.tan(np.arctan2(3.6, far)) * rng.uniform(0.85, 1.1)
        views[f"cam{k + 1}"] = looking_at(centre, np.array([0, 0, 0.8]), focal, size, rng.normal(0, 0.03))
    walkers = [replace(walker, jointed=jointed) for walker in _walkers(rng, people, seconds, stand_s)]
    names = list(views)
    return Yard(views, dict.fromkeys(names, fps), dict.fromkeys(names, 0.0), tuple(walkers), seconds, seed)


def _walkers(rng: np.random.Generator, people: int, seconds: float, stand_s: float) -> list[Walker]:
    hues = rng.permutation(np.arange(people) / people + rng.uniform(0, 1))
    walkers: list[Walker] = []
    turn = rng.uniform(0, 2 * np.pi)
    while len(walkers) < people:
        number = len(walkers)
        angle = turn + 2 * np.pi * (number + rng.uniform(-0.2, 0.2)) / people
        start = rng.uniform(2.2, 2.9) * np.array([np.cos(angle), np.sin(angle)])
        middle = rng.uniform(0.35, 0.8) * np.array([np.cos(angle + np.pi / 2), np.sin(angle + np.pi / 2)])
        leave = angle + np.pi + rng.uniform(-0.5, 0.5)
        end = rng.uniform(2.2, 2.9) * np.array([np.cos(leave), np.sin(leave)])
        back = end + rng.uniform(1.2, 2.2) * np.array([np.cos(leave + 2.2), np.sin(leave + 2.2)])
        meet = stand_s + 0.42 * (seconds - stand_s) + rng.uniform(-0.4, 0.4)
        out = meet + 0.33 * (seconds - stand_s)
        times, knots = [stand_s, meet, out, seconds], [start, middle, end, back]
        if stand_s > 0:
            times, knots = [0.0, *times], [start, *knots]
        shirt = _colour(hues[number], 0.75, rng.uniform(0.5, 0.9))
        trousers = _colour(rng.uniform(), 0.4, rng.uniform(0.2, 0.6))
        height = float(np.clip(rng.normal(1.75, 0.07), 1.5, 2.0))
        walker = Walker(
            number + 1, height, (150, 175, 215), shirt, trousers, np.array(times), np.array(knots, dtype=float)
        )
        if _clear(walker, walkers, seconds):
            walkers.append(walker)
    return walkers


def _clear(walker: Walker, others: Sequence[Walker], seconds: float) -> bool:
    """Whether nobody walks through somebody else."""
    t = np.arange(0, seconds, 0.1)
    path = walker.states(t)[:, :2]
    return all(np.linalg.norm(path - other.states(t)[:, :2], axis=1).min() > 0.55 for other in others)


def _colour(hue: float, saturation: float, value: float) -> Colour:
    k = (np.array([1.0, 3.0, 5.0]) + 6 * hue) % 6  # BGR
    return tuple(float(c) for c in 255 * value * (1 - saturation * np.clip(np.minimum(k, 4 - k), 0, 1)))  # type: ignore[return-value]
