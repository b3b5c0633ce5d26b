"""From the sides of a silhouette to the tracked point in the picture, with the noise of what could be seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.person import Body
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.visibility import expected_boxes
from visfuse_cli.maths import multiview
from visfuse_cli.records import Array, Gaussian
from visfuse_cli.vision.silhouettes import Expected, Sides

UPRIGHT_M = 0.04  # noise of head and feet, which swing less than arms
BREADTH_M = 0.12  # how much a person's width comes and goes with the limbs
LOST_M = 0.6  # noise along a direction in which no side was seen
TALLER = 0.2  # share of the expected height that a box may differ by
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


def tracked_point(
    expected: Expected, who: int, seen: Sides, body: Body, height_sigma: float, config: FuseConfig
) -> tuple[Array, Array] | None:
    """The tracked point (2,) px and its noise (2, 2), from the sides that are the person's own; None without any."""
    scale, sight = float(expected.scale[who]), config.sight
    limb = float(np.hypot(sight.edge_px, sight.edge_m * scale))
    end = float(np.hypot(sight.edge_px, UPRIGHT_M * scale))
    u = _sideways(seen, body.half.mean * scale, limb, BREADTH_M * scale / 2)
    v = _upright(seen, expected.box[who], end, height_sigma * scale, config.fusion.point == "foot")
    if u is None and v is None:
        return None
    unknown = (0.0, (LOST_M * scale) ** 2)
    (du, var_u), (dv, var_v) = u or unknown, v or unknown
    foot, head = expected.axis[who]
    tilt = (head[0] - foot[0]) / min(head[1] - foot[1], -1e-6)
    # The middle was found along rows, so that a shift upwards moves the point along the axis.
    return expected.point[who] + [du + tilt * dv, dv], np.diag([var_u + tilt**2 * var_v, var_v])


def _sideways(seen: Sides, half: float, sigma: float, half_sigma: float) -> tuple[float, float] | None:
    """How far the axis is off, and the variance; one side alone tells it by the usual half width, px."""
    if np.isfinite(seen.middle):
        return seen.middle, sigma**2 / 2
    if np.isfinite(seen.left):
        return half - seen.left, sigma**2 + half_sigma**2
    if np.isfinite(seen.right):
        return seen.right - half, sigma**2 + half_sigma**2
    return None


def _upright(seen: Sides, box: Array, sigma: float, height_sigma: float, foot: bool) -> tuple[float, float] | None:
    """How far the tracked point is off vertically, and the variance; one end alone tells it by the usual height, px."""
    top, bottom = float(seen.box[1] - box[1]), float(seen.box[3] - box[3])
    ends = [seen.top, seen.bottom]
    if all(ends) and abs(bottom - top) > TALLER * (box[3] - box[1]):
        ends[0 if abs(top) > abs(bottom) else 1] = False  # with a wrong height one end is something else's
    if foot:
        if ends[1]:
            return bottom, sigma**2
        return (top, sigma**2 + height_sigma**2) if ends[0] else None
    if all(ends):
        return (top + bottom) / 2, sigma**2 / 2
    return (top if ends[0] else bottom, sigma**2 + (height_sigma / 2) ** 2) if any(ends) else None


def learn_body(body: Body, expected: Expected, who: int, seen: Sides) -> None:
    """Let a person's height and width follow what is seen whole."""
    if seen.share < WHOLE:
        return
    broad, tall = expected.box[who, 2:] - expected.box[who, :2]
    if np.isfinite(seen.middle):
        body.half.learn((seen.left + seen.right) / 2 / float(expected.scale[who]), longest=60.0)
        body.width.learn(body.width.mean * float(seen.box[2] - seen.box[0]) / float(broad), longest=60.0)
    if seen.top and seen.bottom:
        body.height.learn(body.height.mean * float(seen.box[3] - seen.box[1]) / float(tall))
