"""From the sides of a silhouette to the tracked point in the picture, with the noise of what could be seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.person import Scale
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.visibility import expected_boxes
from visfuse_cli.maths import multiview
from visfuse_cli.records import Array, Gaussian
from visfuse_cli.vision.silhouettes import Expected, Sides

UPRIGHT_M = 0.02  # noise of head and feet, which swing less than arms
BREADTH_M = 0.12  # how much a person's width comes and goes with the limbs
LOST_M = 0.6  # noise along a direction in which no side was seen
WIDER_M, TALLER = 0.4, 0.2  # what a box may differ by from the expected width (m) and height (share)
LOOSE_M = 0.35  # how far from the prediction a person's pixels are looked for, at most
WHOLE = 0.6  # share of a person that must be seen for the body's lengths to be learnt


def expect(
    P: Array, beliefs: Gaussian, height: Array, width: Array, rank: NDArray[np.intp], config: FuseConfig
) -> list[Expected]:
    """Where each camera P (C, 3, 4) should see people with these beliefs (T, 6), heights and widths (T,) m."""
    foot = beliefs.mean[:, :3].copy()
    if config.fusion.point == "centroid":
        foot[:, 2] -= height / 2
    up = np.column_stack([0 * height, 0 * height, height])
    box = expected_boxes(P, foot, height, width)
    low, high = (multiview.project(P, point[:, None])[0] for point in (foot, foot + up))
    point, _ = multiview.project(P, beliefs.mean[:, None, :3])
    depth = multiview.depths(P, (foot + up / 2)[:, None])
    scale = np.linalg.norm(high - low, axis=-1) / height[:, None]
    doubt = np.sqrt(np.clip(beliefs.cov[:, 0, 0] + beliefs.cov[:, 1, 1], 0, None))[:, None]
    reach, half = np.minimum(2 * doubt, LOOSE_M) * scale, np.maximum(scale * width[:, None] / 2, 1.0)
    axis = np.stack([low, high], axis=2)
    return [
        Expected(box[:, c], axis[:, c], point[:, c], half[:, c], depth[:, c], scale[:, c], reach[:, c], rank)
        for c in range(len(P))
    ]


def own_sides(seen: Sides, box: Array, scale: float) -> NDArray[np.bool_]:
    """Which sides (left, top, right, bottom) are to be believed: with a wrong extent, not the one that is further off."""
    own = seen.own.copy()
    off = seen.box - box
    for first, second, most in ((0, 2, WIDER_M * scale), (1, 3, TALLER * (box[3] - box[1]))):
        if own[first] and own[second] and abs(off[second] - off[first]) > most:
            own[first if abs(off[first]) > abs(off[second]) else second] = False
    return own


def tracked_point(
    expected: Expected, who: int, seen: Sides, own: NDArray[np.bool_], height_sigma: float, config: FuseConfig
) -> tuple[Array, Array] | None:
    """The tracked point (2,) px and its noise (2, 2), from the sides that are the person's own; None without any."""
    scale, off = float(expected.scale[who]), seen.box - expected.box[who]
    sight = config.sight
    limb = float(np.hypot(sight.edge_px, sight.edge_m * scale))
    end = float(np.hypot(sight.edge_px, UPRIGHT_M * scale))
    foot = config.fusion.point == "foot"
    u = _shift(off[[0, 2]], own[[0, 2]], limb, BREADTH_M * scale, in_middle=True)
    v = _shift(off[[1, 3]], own[[1, 3]], end, height_sigma * scale, in_middle=not foot)
    if u is None and v is None:
        return None
    unknown = (0.0, (LOST_M * scale) ** 2)
    (du, var_u), (dv, var_v) = u or unknown, v or unknown
    return expected.point[who] + [du, dv], np.diag([var_u, var_v])


def _shift(
    off: Array, own: NDArray[np.bool_], sigma: float, extent: float, in_middle: bool
) -> tuple[float, float] | None:
    """How far the tracked point is off the expected one, and the variance, from two opposite sides; None from none.

    A side alone tells it by the expected extent, whose deviation is `extent`; else the point lies on the second side.
    """
    if in_middle:
        if own.all():
            return float(off.mean()), sigma**2 / 2
        return (float(off[own][0]), sigma**2 + (extent / 2) ** 2) if own.any() else None
    if own[1]:
        return float(off[1]), sigma**2
    return (float(off[0]), sigma**2 + extent**2) if own[0] else None


def learn_lengths(height: Scale, width: Scale, expected: Expected, who: int, seen: Sides, own: NDArray[np.bool_]) -> None:
    """Let a person's height and width follow what is seen whole."""
    if seen.share < WHOLE:
        return
    broad, tall = expected.box[who, 2:] - expected.box[who, :2]
    if own[1] and own[3]:
        height.learn(height.mean * float(seen.box[3] - seen.box[1]) / float(tall))
    if own[0] and own[2]:
        width.learn(width.mean * float(seen.box[2] - seen.box[0]) / float(broad), longest=60.0)
