"""The disparity of one target's region: cells of it found in the other view (Jia 2008, sec. 3).

A target is not flat, and its box holds background too: the median over cells leaves both out, where one match of the
whole region would be drawn to whatever has the strongest edges.
"""

from __future__ import annotations

import numpy as np

from visfuse_cli.records import Array
from visfuse_cli.vision import patches
from visfuse_cli.vision.patches import Grey

INNER = 0.7  # share of the region's sides that the cells cover
CELLS = 3  # each way
SMALLEST = 9.0  # px: side of a cell
BACK_PX = 1.0  # by which looking back from the right view may miss


def region_shift(views: dict[str, list[Grey]], left: Array, start: Array, good: float) -> tuple[Array, Array] | None:
    """The shift (2,) px of a left quad's region (4, 2) in the right view, near `start` (2,), and its variances (2,).

    Every cell is found by its grey values, looked for back again, and dropped where that ends elsewhere. None where
    fewer than two cells are left.
    """
    wide, high = patches.side(left)
    count = [int(np.clip(INNER * side / SMALLEST, 1, CELLS)) for side in (wide, high)]
    rim = (1 - INNER) / 2
    size = views["left"][0].shape[1], views["left"][0].shape[0]
    shifts = []
    for j in range(count[1]):
        for i in range(count[0]):
            low = rim + INNER * np.array([i / count[0], j / count[1]])
            top = rim + INNER * np.array([(i + 1) / count[0], (j + 1) / count[1]])
            unit = np.array([[low[0], low[1]], [top[0], low[1]], [top[0], top[1]], [low[0], top[1]]])
            shift = _cell(views, patches.warped(left, unit), start, size, good)
            if shift is not None:
                shifts.append(shift)
    if len(shifts) < min(2, count[0] * count[1]):
        return None
    found = np.array(shifts)
    middle = np.median(found, axis=0)
    spread = 1.4826 * np.median(np.abs(found - middle), axis=0)
    return middle, (1.25 * spread) ** 2 / len(found) + 0.05**2


def _cell(views: dict[str, list[Grey]], cell: Array, start: Array, size: tuple[int, int], good: float) -> Array | None:
    there = cell + start
    if not (patches.inside(cell, size, 0) and patches.inside(there, size, 0)):
        return None
    across = patches.align(views["right"], there, patches.template(views["left"], cell), 0.01)
    if across is None or across.correlation < good:
        return None
    there = there + across.shift
    if not patches.inside(there, size, 0):
        return None
    back = patches.align(views["left"], cell, patches.template(views["right"], there), 0.01)
    if back is None or np.linalg.norm(back.shift) > BACK_PX:
        return None
    return np.asarray(start + across.shift)
