"""Vehicles to choose from, and whether two of them come too near."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from samples.scene import Array, Vehicle

# kind: lengths, widths, heights, m
SIZES = {
    "car": ((4.0, 4.8), (1.7, 1.85), (1.42, 1.65)),
    "van": ((5.0, 6.0), (1.95, 2.05), (2.0, 2.6)),
    "truck": ((8.0, 12.0), (2.45, 2.55), (3.2, 3.8)),
}
COLOURS = (
    (225, 225, 222),
    (185, 188, 190),
    (120, 120, 118),
    (92, 95, 96),
    (48, 45, 44),
    (38, 36, 60),
    (45, 45, 165),
    (60, 70, 200),
    (150, 85, 40),
    (105, 55, 35),
    (70, 105, 60),
    (70, 190, 215),
)


def parked(t: Array) -> Array:
    """The drive of a vehicle that has none yet: it stands at the origin."""
    return np.zeros((len(t), 5))


def random_vehicle(rng: np.random.Generator, number: int, trucks: float = 0.12) -> Vehicle:
    """A vehicle of a random kind, size and colour, parked."""
    kind = str(rng.choice(["truck", "van", "car"], p=[trucks, 0.15, 0.85 - trucks]))
    length, width, height = (round(float(rng.uniform(*limits)), 2) for limits in SIZES[kind])
    shade = rng.uniform(0.9, 1.1)
    blue, green, red = (int(np.clip(channel * shade, 20, 240)) for channel in COLOURS[rng.integers(len(COLOURS))])
    return Vehicle(number, kind, length, width, height, (blue, green, red), parked)


def clear_of(vehicle: Vehicle, others: Sequence[Vehicle], times: Array, gap: float) -> bool:
    """Whether the vehicle keeps `gap` metres from the others at all times (n,) s."""
    own = _discs(vehicle, times)
    for other in others:
        theirs = _discs(other, times)
        reach = (vehicle.width + other.width) / 2 + gap
        between = np.linalg.norm(own[:, :, None] - theirs[:, None, :], axis=-1)
        if between.min() < reach:
            return False
    return True


def _discs(vehicle: Vehicle, times: Array) -> Array:
    """Middles (n, m, 2) of discs of the vehicle's width along its length: near enough to its outline."""
    states = vehicle.trajectory(times)
    along = np.linspace(-1, 1, 7) * (vehicle.length - vehicle.width) / 2
    heading = np.column_stack([np.cos(states[:, 2]), np.sin(states[:, 2])])
    return np.asarray(states[:, None, :2] + along[None, :, None] * heading[:, None, :])
