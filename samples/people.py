"""People in a yard before several cameras: jointed bodies on smooth walks, with all that a test asks for exact."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from scipy.interpolate import PchipInterpolator

from samples.figures import FIGURES, Colour, Piece, Stance
from samples.scene import Array, Camera

STEP_M = 0.7
"""Metres: length of a step; the limbs swing with the way that is walked."""


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
    figure: str = "jointed"
    straight: bool = False

    def states(self, t: Array) -> Array:
        """x, y, vx, vy (n, 4) at times t (n,)."""
        curve = (PchipInterpolator, _Polyline)[self.straight](self.times, self.knots)
        # Pchip stands still where two knots are one; averaging over half a second rounds its and a polyline's corners.
        lags = np.linspace(-0.25, 0.25, 11)
        when = np.clip(t[:, None] + lags, self.times[0], self.times[-1])
        walks = when == t[:, None] + lags  # before and after the walk somebody stands
        return np.column_stack([curve(when).mean(axis=1), (curve.derivative()(when) * walks[..., None]).mean(axis=1)])

    def pieces(self, state: Array, heading: float, way: float) -> list[Piece]:
        """The body at one state (4,), facing `heading` rad, after `way` m of walk."""
        pace = min(float(np.hypot(*state[2:])) / 1.2, 1.0)
        swing = pace * float(np.sin(np.pi * way / STEP_M))
        foot = np.array([state[0], state[1], 0.0])
        stance = Stance(foot, heading, self.height, swing, self.skin, self.shirt, self.trousers)
        return FIGURES[self.figure](stance)


class _Polyline:
    """Straight and steady from knot to knot."""

    def __init__(self, times: Array, knots: Array) -> None:
        self._times, self._knots = times, knots
        self._speeds = np.diff(knots, axis=0) / np.diff(times)[:, None]

    def __call__(self, t: Array) -> Array:
        return np.stack([np.interp(t, self._times, column) for column in self._knots.T], axis=-1)

    def derivative(self) -> Callable[[Array], Array]:
        """The velocities."""
        last = len(self._speeds) - 1
        return lambda t: self._speeds[(np.searchsorted(self._times, t, side="right") - 1).clip(0, last)]


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
    contrast: float = 1.0
    """Of the floor's and walls' pattern."""
    ground: Colour = (125.0, 135.0, 140.0)
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
    figure: str = "jointed",
    far: tuple[float, float] = (5.5, 8.0),
    high: tuple[float, float] = (2.0, 4.5),
) -> Yard:
    """People who come from different sides, cross in the middle within a second and go on; cameras all around."""
    rng = np.random.default_rng((seed, 7))
    turn = rng.uniform(0, 2 * np.pi)
    views = {}
    for k in range(cameras):
        angle = turn + 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) / cameras
        away, up = rng.uniform(*far), rng.uniform(*high)
        centre = np.array([away * np.cos(angle), away * np.sin(angle), up])
        # wide enough that a person at the yard's edge stays in the picture
        focal = size[0] / 2 / np.tan(np.arctan2(3.6, away)) * rng.uniform(0.85, 1.1)
        views[f"cam{k + 1}"] = looking_at(centre, np.array([0, 0, 0.8]), focal, size, rng.normal(0, 0.03))
    walkers = [replace(walker, figure=figure) for walker in _walkers(rng, people, seconds, stand_s)]
    names = list(views)
    return Yard(views, dict.fromkeys(names, fps), dict.fromkeys(names, 0.0), tuple(walkers), seconds, seed)


def varied(seed: int, seconds: float = 12.0) -> Yard:
    """The crossing with bodies, walks, heights, cameras, light, ground and noise drawn by lot."""
    rng = np.random.default_rng((seed, 13))
    size = ((640, 480), (640, 480), (800, 450), (512, 384))[int(rng.integers(4))]
    yard = crossing(seed + 1000, seconds, size=size, far=(4.5, 9.0), high=(1.6, 6.5))
    figure, straight = str(rng.choice(list(FIGURES))), bool(rng.uniform() < 0.5)
    grey = bool(rng.uniform() < 0.25)
    walkers = []
    for walker in yard.walkers:
        height = float(rng.uniform(1.55, 1.95))
        shirt, trousers = (_grey(c) if grey else c for c in (walker.shirt, walker.trousers))
        dressed = replace(walker, shirt=shirt, trousers=trousers)
        walkers.append(replace(dressed, height=height, figure=figure, straight=straight))
    high = rng.uniform(0.5, 0.9)
    sun = (float(rng.normal(0, 0.4)), float(rng.normal(0, 0.4)), float(high)) if rng.uniform() < 0.6 else None
    tone = rng.uniform(60, 190) + rng.normal(0, 12, 3)
    return replace(
        yard,
        walkers=tuple(walkers),
        sun=sun,
        noise=float(rng.choice([0.0, 1.5, 4.0])),
        contrast=float(rng.choice([0.0, 0.3, 1.0])),
        ground=(float(tone[0]), float(tone[1]), float(tone[2])),
    )


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


def _grey(colour: Colour) -> Colour:
    mean = sum(colour) / 3
    return mean, mean, mean


def _colour(hue: float, saturation: float, value: float) -> Colour:
    k = (np.array([1.0, 3.0, 5.0]) + 6 * hue) % 6  # BGR
    return tuple(float(c) for c in 255 * value * (1 - saturation * np.clip(np.minimum(k, 4 - k), 0, 1)))  # type: ignore[return-value]
