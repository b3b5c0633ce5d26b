"""The dark beneath a vehicle: sills and bumpers in their own shade look like a shadow on the ground, but end above it.

On the side of a vehicle that faces the sun there is no shadow of it: what is dark there all along, at one height, is
its own, and the ground begins below it, on its other sides as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, GroundCamera
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.wireframe import Outlines

LEAST_ROWS = 12
LOW_M = 0.17  # what is less high may be the rim of a border
ALIKE = 0.5  # of its height that half of the rows may differ by; less where some lie in the shadow of something else
_SIDES = wireframe.corners(np.zeros(3), 2 * np.ones(3))[:, :2]


def on_the_ground(
    outlines: Outlines, used: NDArray[np.bool_], camera: GroundCamera, pose: Array, size: Array, fall: Array
) -> Outlines:
    """The outlines of a vehicle at poses (T, 3), of a size (3,), with what is dark beneath its paint if that is its
    own, as those frames tell that were `used` (T,). Shadows fall `fall` (2,) m for each metre of height."""
    along, across = np.moveaxis(_SIDES[outlines.corner].mean(axis=2), -1, 0)  # (T, K): where the rows' edges face
    c, s = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
    lit = (c * along - s * across) * fall[0] + (s * along + c * across) * fall[1] < 0
    high = _height(outlines.dark[lit & used[:, None]])
    if not high:
        return outlines
    down = wireframe.downwards(camera, pose, np.tile(size, (len(pose), 1)))
    below = high * np.einsum("tkc,ct->tk", outlines.normal, down)
    return replace(outlines, support=outlines.support + np.where(np.isnan(outlines.dark), 0.0, below))


def _height(dark: Array) -> float:
    """How high (m) the dark is by the rows (n,) that begin in it (see `Outlines`); 0 where it may be a shadow."""
    told, endless = dark[np.isfinite(dark)], np.count_nonzero(np.isinf(dark))
    if len(told) < LEAST_ROWS:
        return 0.0
    low, middle, high = np.quantile(told, (0.25, 0.5, 0.75))
    alike = high - low < ALIKE * middle * len(told) / (len(told) + endless)
    return float(middle) if middle > LOW_M and alike else 0.0
