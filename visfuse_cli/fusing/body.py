"""What is learnt of somebody's body: height, widths, and how far head and feet reach in a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from visfuse_cli.records import Array

HALF_SHARE = 0.33  # half of the usual row's width, as a share of the box's
REACH_SIGMA = 0.06  # m: how much people's heads and feet differ from the usual outline
LEVEL_M = 0.05  # m: how flat the ground is taken to be, and how upright people
DRIFT = 3e-4  # m a look: bodies bend, and shadows come and go


@dataclass(slots=True)
class Scale:
    """A length of the body that is learnt: mean (m) and how many looks stand behind it."""

    mean: float
    looks: float

    def learn(self, value: float, weight: float = 1.0, longest: float = 400.0) -> None:
        """Take in one look."""
        self.looks = min(self.looks + weight, longest)
        self.mean += (value - self.mean) * weight / self.looks


@dataclass(slots=True)
class Ends:
    """Height, and what head and feet reach towards the side that a camera sees beyond the usual outline: (3,) m.

    A camera that looks down sees the far edge of the head above, and the near edge of the feet below. Feet stand on
    the ground, which tells the height from what the feet reach.
    """

    mean: Array
    cov: Array

    @property
    def height(self) -> float:
        """m."""
        return float(self.mean[0])

    def learn(self, level: float, h: Array, sigma: float) -> None:
        """Take in that h (3,) @ (height, head, feet) was seen to be `level` m, give or take `sigma`."""
        cov = self.cov + DRIFT**2 * np.eye(3)
        spread = cov @ h
        gain = spread / (h @ spread + sigma**2)
        self.mean = self.mean + gain * (level - h @ self.mean)
        self.cov = cov - np.outer(gain, spread)


@dataclass(slots=True)
class Body:
    """What is known of somebody's measures: ends, width of the whole box, and half the width of the usual row, m."""

    ends: Ends
    width: Scale
    half: Scale

    def level(self, centroid: bool) -> tuple[float, float]:
        """How high above the ground the tracked point is, the centroid or the foot, m, and give or take what."""
        share = 0.5 if centroid else 0.0
        return share * self.ends.height, float(np.hypot(LEVEL_M, share * np.sqrt(self.ends.cov[0, 0])))


def usual_body(height: float, height_sigma: float, width: float, looks: float) -> Body:
    """A body of usual measures; the widths count for so many looks."""
    ends = Ends(np.array([height, 0.0, 0.0]), np.diag([height_sigma, REACH_SIGMA, REACH_SIGMA]) ** 2)
    return Body(ends, Scale(width, looks), Scale(HALF_SHARE * width, looks))
