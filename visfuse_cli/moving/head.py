"""A stereo head at one instant: where it is, and the pair of pictures it takes there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visfuse_cli.records import Array, Image
from visfuse_cli.vision.patches import Grey


@dataclass(frozen=True, slots=True)
class Head:
    """Where the left camera is at one instant: x_world = R x_camera + T."""

    t: float
    R: Array
    T: Array

    def inside(self, points: Array) -> Array:
        """World points (..., 3) m in the camera's frame."""
        return np.asarray((points - self.T) @ self.R)

    def outside(self, points: Array) -> Array:
        """Points (..., 3) m of the camera's frame in the world."""
        return np.asarray(points @ self.R.T + self.T)


@dataclass(frozen=True, slots=True)
class Pair:
    """One pair of straight pictures: number, head, pictures by view, the left one's pyramid, and the flow to it, px."""

    frame: int
    head: Head
    pictures: Mapping[str, Image]
    levels: list[Grey]
    flow: Array | None

    @property
    def t(self) -> float:
        """s."""
        return self.head.t

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, px."""
        return self.levels[0].shape[1], self.levels[0].shape[0]
