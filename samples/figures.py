"""Bodies of people, made of convex pieces: jointed ones whose limbs swing, and plain shapes that stand for people."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from samples.scene import Array, Camera

Colour = tuple[float, float, float]
RING = np.linspace(0, 2 * np.pi, 14, endpoint=False)
CIRCLE = np.column_stack([np.cos(RING), np.sin(RING)])
BALL = np.concatenate(
    [
        np.column_stack([np.cos(up) * CIRCLE, np.full(len(CIRCLE), np.sin(up))])
        for up in np.radians([-70, -35, 0, 35, 70])
    ]
    + [np.array([[0, 0, -1.0], [0, 0, 1.0]])]
)
"""Points (n, 3) on the unit sphere."""


@dataclass(frozen=True, slots=True)
class Capsule:
    """From a to b (3,) m, with radii m."""

    a: Array
    b: Array
    radius_a: float
    radius_b: float
    colour: Colour

    def ends(self) -> Array:
        """The two ends."""
        return np.stack([self.a, self.b])

    def outline(self, camera: Camera) -> Array:
        """Around two discs."""
        radius = np.array([self.radius_a, self.radius_b]) * camera.K[0, 0] / camera.depth(self.ends())
        return _hull((camera.project(self.ends())[:, None] + radius[:, None, None] * CIRCLE).reshape(-1, 2))

    def cast(self, sun: Array) -> Array:
        """The shadows of two level discs."""
        level = np.column_stack([CIRCLE, np.zeros(len(CIRCLE))])
        return _on_ground(np.concatenate([self.a + self.radius_a * level, self.b + self.radius_b * level]), sun)


@dataclass(frozen=True, slots=True)
class Solid:
    """The convex hull of points (n, 3) m."""

    points: Array
    colour: Colour

    def ends(self) -> Array:
        """All of its points."""
        return self.points

    def outline(self, camera: Camera) -> Array:
        """Around all points."""
        return _hull(camera.project(self.points))

    def cast(self, sun: Array) -> Array:
        """The shadows of all points."""
        return _on_ground(self.points, sun)


Piece = Capsule | Solid
"""A convex piece of a body, BGR: how far away its ends are, its outline in a picture, and the shadow it casts."""


@dataclass(frozen=True, slots=True)
class Stance:
    """How somebody stands: foot (3,) m, heading rad, height m, how far (rad-like, -1 to 1) the limbs swing, clothes."""

    foot: Array
    heading: float
    height: float
    swing: float
    skin: Colour
    shirt: Colour
    trousers: Colour

    def at(self, forward: float, side: float, up: float) -> Array:
        """The point (3,) m at shares of the height ahead, to the left, and up."""
        ahead = np.array([np.cos(self.heading), np.sin(self.heading), 0.0])
        left = np.array([-ahead[1], ahead[0], 0.0])
        return np.asarray(self.foot + self.height * (forward * ahead + side * left + np.array([0, 0, up])))

    def ring(self, points: Array) -> Array:
        """Points (n, 3) m of points (n, 3) in shares of the height, turned to the heading."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.asarray(self.foot + self.height * points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]))

    def capsule(
        self, a: tuple[float, float, float], b: Array, radius_a: float, radius_b: float, colour: Colour
    ) -> Capsule:
        """A capsule from shares of the height to a point (3,) m; radii in shares of the height."""
        return Capsule(self.at(*a), b, radius_a * self.height, radius_b * self.height, colour)


def jointed(s: Stance) -> list[Piece]:
    """Trunk, shoulders, head; legs and arms that swing against each other."""
    at = s.at
    parts: list[Piece] = [
        s.capsule((0, 0, 0.5), at(0, 0, 0.78), 0.09, 0.1, s.shirt),
        s.capsule((0, 0.05, 0.79), at(0, -0.05, 0.79), 0.06, 0.06, s.shirt),
        s.capsule((0, 0, 0.935), at(0, 0, 0.925), 0.065, 0.065, s.skin),
    ]
    for side in (1.0, -1.0):
        reach = side * s.swing * 0.16
        knee, ankle = (0.6 * reach, side * 0.05, 0.27), (reach, side * 0.05, 0.035)
        hand = (-0.8 * reach, side * 0.14, 0.46)
        parts += [
            s.capsule((0, side * 0.05, 0.5), at(*knee), 0.055, 0.042, s.trousers),
            s.capsule(knee, at(*ankle), 0.042, 0.032, s.trousers),
            s.capsule(ankle, at(reach + 0.08, side * 0.05, 0.02), 0.03, 0.02, (40, 40, 45)),
            s.capsule((0, side * 0.115, 0.79), at(*hand), 0.032, 0.026, s.shirt),
            s.capsule(hand, at(*hand) - [0, 0, 0.03 * s.height], 0.028, 0.02, s.skin),
        ]
    return parts


def pillar(s: Stance) -> list[Piece]:
    """Three upright capsules: legs, trunk, head."""
    return [
        s.capsule((0, 0, 0.12), s.at(0, 0, 0.5), 0.12, 0.12, s.trousers),
        s.capsule((0, 0, 0.5), s.at(0, 0, 0.72), 0.12, 0.12, s.shirt),
        s.capsule((0, 0, 0.92), s.at(0, 0, 0.91), 0.08, 0.08, s.skin),
    ]


def cylinder(s: Stance) -> list[Piece]:
    """One upright cylinder in two colours."""
    return _stacked(s, np.column_stack([0.125 * CIRCLE, np.zeros(len(CIRCLE))]))


def block(s: Stance) -> list[Piece]:
    """One upright box in two colours."""
    square = np.array([[0.085, 0.14], [-0.085, 0.14], [-0.085, -0.14], [0.085, -0.14]])
    return _stacked(s, np.column_stack([square, np.zeros(4)]))


def ellipsoid(s: Stance) -> list[Piece]:
    """One upright ellipsoid."""
    return [Solid(s.ring(BALL * [0.13, 0.15, 0.5] + [0, 0, 0.5]), s.shirt)]


def dressed(s: Stance) -> list[Piece]:
    """A cone of a coat, shoulders, and a ball for the head."""
    hem, top = np.column_stack([0.15 * CIRCLE, np.zeros(14)]), np.column_stack([0.08 * CIRCLE, np.full(14, 0.82)])
    head = Solid(s.ring(0.075 * BALL + [0, 0, 0.925]), s.skin)
    return [Solid(s.ring(np.concatenate([hem, top])), s.shirt), head]


def _stacked(s: Stance, ring: Array) -> list[Piece]:
    """Legs and trunk with one cross section (n, 3)."""
    levels = ((0.0, 0.48, s.trousers), (0.48, 1.0, s.shirt))
    return [
        Solid(s.ring(np.concatenate([ring + [0, 0, low], ring + [0, 0, high]])), colour) for low, high, colour in levels
    ]


FIGURES: dict[str, Callable[[Stance], list[Piece]]] = {
    "jointed": jointed,
    "pillar": pillar,
    "cylinder": cylinder,
    "block": block,
    "ellipsoid": ellipsoid,
    "dressed": dressed,
}


def _hull(points: Array) -> Array:
    return np.asarray(cv2.convexHull(points.astype(np.float32)).reshape(-1, 2), dtype=float)


def _on_ground(points: Array, sun: Array) -> Array:
    return np.asarray(points - points[:, 2:] * sun / sun[2])
