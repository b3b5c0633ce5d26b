"""The disparity of one target's region: cells of it found in the other view by sums of differences (Jia 2008, sec. 3).

A target is not flat, and its box holds background too: the median over cells leaves both out, where one match of the
whole region would be drawn to whatever has the strongest edges.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from visfuse_cli.records import Array, Image
from visfuse_cli.vision import patches

INNER = 0.7  # share of the region's sides that the cells cover
OUTER = 1.2  # and where nothing is found there: the outline, too
CELLS = 3  # each way
SMALLEST = 9.0  # px: side of a cell
MOST = 12  # samples along a side of a cell
STEP = 0.5  # px between the shifts that are tried
ROUNDS = 2  # by which the best of them is refined to parts of a pixel
NEAR = 2.5  # times the cells' scatter around their median: what is further off is something else
BACK_PX = 1.0  # by which looking back from the right view may miss
OUTLINE = 0.25  # px: noise of a shift by the outline alone, behind which other background shows in each view
FLOOR = 0.03  # px, and the deviation is no less
# What parts of a pixel are told by: brightness, and blue and red beside it. Compressed footage has these at half size.
BRIGHT, HUE = np.array([0.114, 0.587, 0.299], np.float32), 0.05
FINE = np.stack(
    [BRIGHT, HUE * (np.eye(3, dtype=np.float32)[0] - BRIGHT), HUE * (np.eye(3, dtype=np.float32)[2] - BRIGHT)]
)
CLEAR = (18.0, 0.75)  # a match is one up to so many grey levels a sample, and up to so much of the middle shift's
VAGUE = (45.0, 0.93)  # where background is part of the cells


def region_shift(
    pictures: Mapping[str, Image], left: Array, right: Array, along: Array, reach: float
) -> tuple[Array, Array] | None:
    """The right quad (4, 2) that shows what the left one (4, 2) does, and the variances (2,) px^2 of its place.

    It is looked for from `right` (4, 2) up to `reach` px both ways in the direction `along` (2,). Cells are matched by
    sums of absolute differences of colour, to parts of a pixel, looked for back again, and dropped where that ends
    elsewhere. None where fewer than two cells, or less than a third of them, agree.
    """
    count = [int(np.clip(INNER * each / SMALLEST, 1, CELLS)) for each in patches.side(left)]
    found = _shift(pictures, left, right, along, reach, _cells(left, INNER, count), CLEAR)
    if found is not None:
        return found
    found = _shift(pictures, left, right, along, reach, _cells(left, OUTER, [1, CELLS]), VAGUE)
    return None if found is None else (found[0], found[1] + (OUTLINE * along) ** 2)  # a plain thing has but its outline


def _shift(
    pictures: Mapping[str, Image],
    left: Array,
    right: Array,
    along: Array,
    reach: float,
    cells: Array,
    clear: tuple[float, float],
) -> tuple[Array, Array] | None:
    """As `region_shift`, by given cells (c, n, 2) of the unit square, `clear` enough."""
    here = _seen(pictures["left"], patches.warped(left, cells.reshape(-1, 2)).reshape(cells.shape))
    there = patches.warped(right, cells.reshape(-1, 2)).reshape(cells.shape)
    shift = np.arange(-reach, reach + STEP / 2, STEP)
    found, cost, spread = _best(pictures["right"], here, there, along, shift, clear[1])
    fits = np.isfinite(found) & (cost < clear[0])
    at = there + np.nan_to_num(found)[:, None, None] * along
    short = np.arange(-2 * BACK_PX, 2 * BACK_PX + STEP / 2, STEP)
    base = patches.warped(left, cells.reshape(-1, 2)).reshape(cells.shape)
    back, _, _ = _best(pictures["left"], _seen(pictures["right"], at), base, along, short, 1.0)
    fits &= np.abs(np.nan_to_num(back, nan=np.inf)) < BACK_PX
    if np.count_nonzero(fits) < max(min(2, len(cells)), len(cells) / 3):
        return None
    middle, variance = _agreed(found[fits], spread[fits])
    return right + middle * along, (variance + FLOOR**2) * along**2 + 0.05**2


def _agreed(found: Array, variance: Array) -> tuple[float, float]:
    """One shift (px) of those of cells (c,) with their variances, and its own: the mean of those near the median."""
    middle = np.median(found)
    scatter = 1.4826 * float(np.median(np.abs(found - middle)))
    near = np.abs(found - middle) <= max(NEAR * scatter, FLOOR)
    weight = near / (variance + scatter**2 + FLOOR**2)
    mean = float(weight @ found / weight.sum())
    return mean, max(1 / float(weight.sum()), float(weight**2 @ (found - mean) ** 2 / weight.sum() ** 2))


def _cells(quad: Array, share: float, count: list[int]) -> Array:
    """Samples (c, n, 2) of the unit square in cells over a share of its sides."""
    most = MOST * CELLS // count[0], MOST
    samples = [int(np.clip(share * s / c, 4, m)) for s, c, m in zip(patches.side(quad), count, most, strict=True)]
    own = patches.grid((samples[0], samples[1])) / count
    corners = np.stack(np.meshgrid(np.arange(count[0]) / count[0], np.arange(count[1]) / count[1]), -1).reshape(-1, 2)
    return np.asarray((1 - share) / 2 + share * (corners[:, None] + own))


def _seen(picture: Image, at: Array) -> Array:
    """Colours (..., 3) at pixels (..., 2); NaN outside."""
    flat = at.reshape(-1, at.shape[-2], 2).astype(np.float32)
    values = cv2.remap(picture, flat, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    high, wide = picture.shape[:2]
    inside = np.all((flat >= 0) & (flat <= np.array([wide - 1, high - 1])), axis=-1)
    values[~inside] = np.nan
    return np.asarray(values.reshape(*at.shape[:-1], 3))


def _best(
    picture: Image, wanted: Array, at: Array, along: Array, shift: Array, clear: float
) -> tuple[Array, Array, Array]:
    """Of each cell the shift (c,) px at which its colours (c, n, 3) fit best, how well, and the shift's variance.

    at (c, n, 2) are its pixels where the shift is zero. The shift is NaN where the best is at the rim, or does not
    stand out.
    """
    cost = _differences(picture, wanted, at, along, shift[:, None])  # (s, c)
    best = np.clip(np.argmin(cost, axis=0), 1, len(shift) - 2)
    each = np.arange(len(at))
    low, least, high = (cost[best + k, each] for k in (-1, 0, 1))
    middle = np.median(cost, axis=0)
    with np.errstate(invalid="ignore"):
        doubtful = (least > low) | (least > high) | ~np.isfinite(low + high) | (least > clear * middle)
    found = shift[best].copy()
    for _ in range(ROUNDS):
        tried = _seen(picture, at + (found + np.array([[-0.5], [0.0], [0.5]]))[..., None, None] * along)
        slope, off = (tried[2] - tried[0]) @ FINE.T, (tried[1] - wanted) @ FINE.T
        off = off - off.mean(axis=1, keepdims=True)
        slope = slope - slope.mean(axis=1, keepdims=True)
        steep = np.sum(slope**2, axis=(1, 2)) + 1e-6
        found = found - np.clip(np.nan_to_num(np.sum(slope * off, axis=(1, 2)) / steep), -STEP, STEP)
    variance = np.mean(off**2, axis=(1, 2)) / steep
    doubtful |= ~np.isfinite(variance) | (np.abs(found - shift[best]) > 2 * STEP)
    return np.where(doubtful, np.nan, found), least, variance


def _differences(picture: Image, wanted: Array, at: Array, along: Array, shift: Array) -> Array:
    """Mean absolute differences (s, c) of cells (c, n, 3) at shifts (s, 1) px; infinite outside of the picture."""
    off = _seen(picture, at + shift[..., None, None] * along) - wanted
    off -= off.mean(axis=2, keepdims=True)  # cameras differ in exposure
    cost = np.mean(np.abs(off), axis=(2, 3))
    return np.where(np.isfinite(cost), cost, np.inf)
