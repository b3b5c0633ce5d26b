"""What a vehicle looks like: patches of colour on the faces of its box."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from samples.scene import FACES, Array, Vehicle

Colour = tuple[float, float, float]
GLASS: Colour = (58, 50, 44)
TYRE: Colour = (30, 30, 30)
BUMPER: Colour = (52, 52, 52)
PLATE: Colour = (215, 225, 225)
LAMPS: dict[str, Colour] = {"front": (245, 250, 250), "rear": (40, 30, 190)}
WHEEL_RADIUS = {"car": 0.33, "van": 0.36, "truck": 0.5}
ROUND = np.linspace(0, 2 * np.pi, 16, endpoint=False)


@dataclass(frozen=True, slots=True)
class Patch:
    """A convex polygon (N, 2) on a face: right and up, each 0 to 1; colour BGR before the light."""

    face: str
    outline: Array
    colour: Colour
    base: bool = False

    def points(self, corners: Array) -> Array:
        """World points (N, 3) m on a box with these corners (8, 3)."""
        a, b, _, d = (corners[i] for i in FACES[self.face])
        return np.asarray(a + self.outline[:, :1] * (b - a) + self.outline[:, 1:] * (d - a))


def body(vehicle: Vehicle, seed: int) -> list[Patch]:
    """The patches of a vehicle in drawing order; no two vehicles of a scene look alike."""
    rng = np.random.default_rng((seed, vehicle.id))
    paint: Colour = vehicle.colour
    patches = [Patch(face, _rectangle(0, 0, 1, 1), paint, base=True) for face in FACES]
    patches += {"car": _car, "van": _van, "truck": _truck}[vehicle.kind](paint, rng)
    for face in ("left", "right"):
        patches += _wheels(vehicle, face)
    for face, lamp in LAMPS.items():
        low = 0.36 if vehicle.kind == "car" else 0.22
        patches += [Patch(face, _rectangle(u, low, u + 0.15, low + 0.12), lamp) for u in (0.04, 0.81)]
        patches.append(Patch(face, _rectangle(0, 0, 1, 0.14), BUMPER))
        patches.append(Patch(face, _rectangle(0.36, 0.16, 0.64, 0.24), PLATE))
    return patches


def _rectangle(left: float, low: float, right: float, high: float) -> Array:
    return np.array([[left, low], [right, low], [right, high], [left, high]], dtype=float)


def _darker(colour: Colour, by: float) -> Colour:
    return colour[0] * by, colour[1] * by, colour[2] * by


def _car(paint: Colour, rng: np.random.Generator) -> Iterator[Patch]:
    nose, tail = rng.uniform(0.7, 0.76), rng.uniform(0.08, 0.2)
    for face in ("left", "right"):
        middle = rng.uniform(0.42, 0.5)
        yield Patch(face, _rectangle(tail + 0.02, 0.6, middle - 0.015, 0.92), GLASS)
        pillar = middle + 0.015
        yield Patch(face, np.array([[pillar, 0.6], [nose + 0.1, 0.6], [nose, 0.92], [pillar, 0.92]]), GLASS)
        yield Patch(face, _rectangle(middle - 0.005, 0.18, middle + 0.005, 0.6), _darker(paint, 0.6))
        yield Patch(face, _rectangle(0, 0, 1, 0.1), BUMPER)
    for face in ("front", "rear"):
        yield Patch(face, np.array([[0.06, 0.58], [0.94, 0.58], [0.86, 0.93], [0.14, 0.93]]), GLASS)
    yield Patch("roof", _rectangle(0.88, 0, 1, 1), _darker(paint, 0.92))
    for low, high in ((nose + 0.12, nose), (tail - 0.05, tail + 0.04)):
        yield Patch("roof", np.array([[low, 0.1], [low, 0.9], [high, 0.84], [high, 0.16]]), GLASS)


def _van(paint: Colour, rng: np.random.Generator) -> Iterator[Patch]:
    stripe: Colour = (float(rng.uniform(30, 220)), float(rng.uniform(30, 220)), float(rng.uniform(30, 220)))
    for face in ("left", "right"):
        yield Patch(face, np.array([[0.68, 0.55], [0.93, 0.55], [0.87, 0.86], [0.68, 0.86]]), GLASS)
        yield Patch(face, _rectangle(0.12, 0.4, 0.6, 0.47), stripe)
        yield Patch(face, _rectangle(0.635, 0.15, 0.645, 0.88), _darker(paint, 0.6))
    yield Patch("front", _rectangle(0.08, 0.52, 0.92, 0.85), GLASS)
    for left in (0.1, 0.53):
        yield Patch("rear", _rectangle(left, 0.55, left + 0.37, 0.82), GLASS)
    yield Patch("roof", _rectangle(0.84, 0.06, 0.94, 0.94), GLASS)


def _truck(paint: Colour, rng: np.random.Generator) -> Iterator[Patch]:
    cab = float(rng.uniform(0.78, 0.84))
    cargo: Colour = (235, 235, 232) if rng.random() < 0.5 else _darker(paint, 1.25)
    stripe: Colour = (float(rng.uniform(30, 200)), float(rng.uniform(30, 200)), float(rng.uniform(30, 200)))
    for face in ("left", "right"):
        yield Patch(face, _rectangle(0, 0.28, cab - 0.02, 1), cargo)
        yield Patch(face, _rectangle(0, 0, cab - 0.02, 0.28), BUMPER)
        yield Patch(face, _rectangle(0.1, 0.5, cab - 0.15, 0.68), stripe)
        yield Patch(face, _rectangle(cab - 0.02, 0.2, cab, 1), BUMPER)
        yield Patch(face, _rectangle(cab + 0.05, 0.5, 0.97, 0.78), GLASS)
    yield Patch("roof", _rectangle(0, 0, cab - 0.02, 1), cargo)
    yield Patch("roof", _rectangle(cab - 0.02, 0, cab, 1), BUMPER)
    yield Patch("rear", _rectangle(0.03, 0.28, 0.97, 0.97), cargo)
    yield Patch("rear", _rectangle(0.49, 0.28, 0.51, 0.97), BUMPER)
    yield Patch("front", _rectangle(0.06, 0.45, 0.94, 0.75), GLASS)


def _wheels(vehicle: Vehicle, face: str) -> Iterator[Patch]:
    radius = WHEEL_RADIUS[vehicle.kind]
    for centre in (0.18, 0.82):
        for share, colour in ((1.0, TYRE), (0.5, (150.0, 150.0, 150.0))):
            ring = radius * share * np.column_stack([np.cos(ROUND), np.sin(ROUND)]) + (0, radius)
            yield Patch(face, ring / (vehicle.length, vehicle.height) + (centre, 0), colour)
