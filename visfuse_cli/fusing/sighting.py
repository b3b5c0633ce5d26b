"""From the sides of a silhouette to the tracked point in the picture, with the noise of what could be seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.body import Body
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.visibility import expected_boxes, standing
from visfuse_cli.maths import multiview
from visfuse_cli.records import Array, Gaussian
from visfuse_cli.vision.silhouettes import Expected, Sides

UPRIGHT_M = 0.04  # noise of head and feet, which swing less than arms
BREADTH_M = 0.12  # how much a person's width comes and goes with the limbs
LOST_M = 0.6  # noise along a direction in which no side was seen
TALLER = 0.2  # share of the expected height that a box may differ by
LOOSE_M = 0.35  # how far from the prediction a person's pixels are looked for, at most
WHOLE = 0.4  # share of a person that must be seen for the body's lengths to be learnt
POSTURE_M = 0.03  # how much the height comes and goes
ENDS_M = 0.08  # noise of one look at where head or feet end
UNDER_M = 0.12  # what reaches farther below the ground than this, the doubt of the place aside, is a reflection
STRANGE_M = 0.5  # what ends farther from where it is expected is something else


def expect(
    P: Array, beliefs: Gaussian, bodies: list[Body], rank: NDArray[np.intp], config: FuseConfig
) -> list[Expected]:
    """Where each camera P (C, 3, 4) should see people with these beliefs (T, 6) and bodies (T)."""
    height, head, feet = np.array([body.ends.mean for body in bodies]).reshape(-1, 3).T
    width = np.array([body.width.mean for body in bodies])
    foot = standing(beliefs, height, config)
    up = np.column_stack([0 * height, 0 * height, height])
    box = expected_boxes(P, foot, height, width)
    low, high = (multiview.project(P, point[:, None])[0] for point in (foot, foot + up))
    point, _ = multiview.project(P, beliefs.mean[:, None, :3])
    depth = multiview.depths(P, (foot + up / 2)[:, None])
    scale = np.linalg.norm(high - low, axis=-1) / height[:, None]
    slope = multiview.slopes(P, foot)
    box[..., 1] -= scale * slope * head[:, None]
    box[..., 3] += scale * slope * feet[:, None]
    doubt = np.sqrt(np.clip(beliefs.cov[:, 0, 0] + beliefs.cov[:, 1, 1], 0, None))[:, None]
    reach, half = np.minimum(2 * doubt, LOOSE_M) * scale, np.maximum(scale * width[:, None] / 2, 1.0)
    axis = np.stack([low, high], axis=2)
    return [
        Expected(
            box=box[:, c],
            axis=axis[:, c],
            point=point[:, c],
            half_width=half[:, c],
            depth=depth[:, c],
            scale=scale[:, c],
            slope=slope[:, c],
            level=foot[:, 2],
            reach=reach[:, c],
            rank=rank,
        )
        for c in range(len(P))
    ]


def tracked_point(
    expected: Expected, who: int, seen: Sides, body: Body, config: FuseConfig
) -> tuple[Array, Array, Array] | None:
    """The tracked point (2,) px, its noise (2, 2) and lever (3,), from the sides that are the person's own, or None."""
    scale, sight = float(expected.scale[who]), config.sight
    limb = float(np.hypot(sight.edge_px, sight.edge_m * scale))
    end = float(np.hypot(sight.edge_px, UPRIGHT_M * scale))
    u = _sideways(seen, body.half.mean * scale, limb, BREADTH_M * scale / 2)
    height_sigma = float(np.hypot(np.sqrt(body.ends.cov[0, 0]), POSTURE_M))
    foot_only = config.fusion.point == "foot"
    ends = _ends(seen, expected.box[who], lowest(expected, who))
    v = _upright(seen, expected.box[who], ends, end, height_sigma * scale, foot_only)
    if u is None and v is None:
        return None
    unknown = (0.0, (LOST_M * scale) ** 2)
    (du, var_u), (dv, var_v) = u or unknown, v or unknown
    foot, head = expected.axis[who]
    tilt = (head[0] - foot[0]) / min(head[1] - foot[1], -1e-6)
    # The middle was found along rows, so that a shift upwards moves the point along the axis.
    z, R = expected.point[who] + [du + tilt * dv, dv], np.diag([var_u + tilt**2 * var_v, var_v])
    return z, R, _lever(ends, float(expected.slope[who]), foot_only)


def _sideways(seen: Sides, half: float, sigma: float, half_sigma: float) -> tuple[float, float] | None:
    """How far the axis is off, and the variance; one side alone tells it by the usual half width, px."""
    if np.isfinite(seen.middle):
        return seen.middle, sigma**2 / 2
    if np.isfinite(seen.left):
        return half - seen.left, sigma**2 + half_sigma**2
    if np.isfinite(seen.right):
        return seen.right - half, sigma**2 + half_sigma**2
    return None


def lowest(expected: Expected, who: int) -> float:
    """The lowest row (px) that somebody's own feet reach."""
    return float(expected.box[who, 3] + UNDER_M * expected.scale[who] + expected.reach[who])


def _ends(seen: Sides, box: Array, lowest: float) -> tuple[bool, bool]:
    """Whether top and bottom tell anything; what is below the `lowest` row is a reflection."""
    top, bottom = float(seen.box[1] - box[1]), float(seen.box[3] - box[3])
    if seen.box[3] > lowest:
        return seen.top, False
    if seen.top and seen.bottom and abs(bottom - top) > TALLER * (box[3] - box[1]):
        # with a wrong height one end is something else's
        return (False, True) if abs(top) > abs(bottom) else (True, False)
    return seen.top, seen.bottom


def _upright(
    seen: Sides, box: Array, ends: tuple[bool, bool], sigma: float, height_sigma: float, foot: bool
) -> tuple[float, float] | None:
    """How far the tracked point is off vertically, and the variance; one end alone tells it by the usual height, px."""
    top, bottom = float(seen.box[1] - box[1]), float(seen.box[3] - box[3])
    if foot:
        if ends[1]:
            return bottom, sigma**2
        return (top, sigma**2 + height_sigma**2) if ends[0] else None
    if all(ends):
        return (top + bottom) / 2, sigma**2 / 2
    return (top if ends[0] else bottom, sigma**2 + (height_sigma / 2) ** 2) if any(ends) else None


def _lever(ends: tuple[bool, bool], slope: float, foot: bool) -> Array:
    """How many m the tracked point moves up for each m of height, head and feet (3,)."""
    by_top, by_bottom = np.array([-1.0, -slope, 0.0]), np.array([0.0, 0.0, slope])
    if foot:
        return by_bottom if ends[1] else by_top if ends[0] else 0 * by_top
    by_top[0], by_bottom[0] = -0.5, 0.5
    told = [lever for lever, there in ((by_top, ends[0]), (by_bottom, ends[1])) if there]
    return np.mean(told, axis=0) if told else 0 * by_top


def learn_body(body: Body, assumed: Array, expected: Expected, who: int, seen: Sides) -> None:
    """Let a person's measures follow what is seen of it; `assumed` (3,) m are the ends that were expected."""
    if seen.share < WHOLE:
        return
    scale, slope, level = (float(each[who]) for each in (expected.scale, expected.slope, expected.level))
    broad = float(expected.box[who, 2] - expected.box[who, 0])
    if np.isfinite(seen.middle):
        body.half.learn((seen.left + seen.right) / 2 / scale, longest=60.0)
        body.width.learn(body.width.mean * float(seen.box[2] - seen.box[0]) / broad, longest=60.0)
    up = (expected.box[who] - seen.box) / scale  # m: how much higher than expected a side is
    height, head, feet = assumed
    if seen.top and abs(up[1]) < STRANGE_M:
        body.ends.learn(level + height + slope * head + up[1], np.array([1.0, slope, 0.0]), ENDS_M)
    if seen.bottom and seen.box[3] <= lowest(expected, who) and up[3] < STRANGE_M:
        body.ends.learn(-(level - slope * feet + up[3]), np.array([0.0, 0.0, slope]), ENDS_M)
