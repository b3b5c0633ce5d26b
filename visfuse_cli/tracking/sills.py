"""What lies beneath the border that was found of a vehicle and is its own: dark sills, and bumpers below a gap.

Sills in their own shade look like a shadow on the ground. On the side of a vehicle that faces the sun there is no
shadow of it: what is dark there all along, at one height, is its own. And where a panel is as grey as the road, what is
below it, all along at one height, belongs to the vehicle as well. The ground begins below either, on all sides.
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
ALIKE = 0.5  # of its height that half of the rows may differ by; less where some do not tell it
MOST = 0.5  # of the rows must see paint below a gap
_SIDES = wireframe.corners(np.zeros(3), 2 * np.ones(3))[:, :2]


def on_the_ground(
    outlines: Outlines, used: NDArray[np.bool_], camera: GroundCamera, pose: Array, size: Array, fall: Array | None
) -> Outlines:
    """The outlines of a vehicle at poses (T, 3), of a size (3,), with what is its own beneath their border, as those
    frames tell that were `used` (T,). Shadows fall `fall` (2,) m for each metre of height, where that is known."""
    high, rows = 0.0, ~np.isnan(outlines.dark)
    if fall is not None:
        high = _height(outlines.dark[rows & used[:, None] & _sunny(outlines, pose, fall)])
    if not high:
        high, rows = _below_a_gap(outlines.paint, used)
    if not high:
        return outlines
    down = wireframe.downwards(camera, pose, np.tile(size, (len(pose), 1)))
    below = high * np.einsum("tkc,ct->tk", outlines.normal, down)
    return replace(outlines, support=outlines.support + np.where(rows, below, 0.0))


def _sunny(outlines: Outlines, pose: Array, fall: Array) -> NDArray[np.bool_]:
    """Which rows (T, K) lie on edges that face the sun."""
    along, across = np.moveaxis(_SIDES[outlines.corner].mean(axis=2), -1, 0)  # in the vehicle's axes
    c, s = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
    return np.asarray((c * along - s * across) * fall[0] + (s * along + c * across) * fall[1] < 0)


def _height(found: Array) -> float:
    """How far (m) below the border that ends which was found in rows (n,), inf where they do not tell; 0 where they do
    not agree."""
    told = found[np.isfinite(found)]
    if len(told) < LEAST_ROWS:
        return 0.0
    low, middle, high = np.quantile(told, (0.25, 0.5, 0.75))
    return float(middle) if middle > LOW_M and high - low < ALIKE * middle * len(told) / len(found) else 0.0


def _below_a_gap(paint: Array, used: NDArray[np.bool_]) -> tuple[float, NDArray[np.bool_]]:
    """The same of the paint below (T, K), see `Outlines`, 0 where most rows see none; and the rows of the frames in
    which most see it: in others the border may lie below the gap."""
    looked, found = ~np.isnan(paint), paint > 0
    told = np.count_nonzero(np.isfinite(paint[used]) & found[used])
    high = _height(paint[used][found[used]]) if told > MOST * np.count_nonzero(looked[used]) else 0.0
    frames = np.count_nonzero(found, axis=1) > MOST * np.count_nonzero(looked, axis=1)
    return high, looked & frames[:, None]
