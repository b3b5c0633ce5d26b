"""A patch of the left view found in the right one, over all depths."""

from __future__ import annotations

import numpy as np

from visfuse_cli.maths.planes import in_right, projected
from visfuse_cli.records import Array, StereoRig
from visfuse_cli.vision import patches
from visfuse_cli.vision.patches import Grey

NEAREST, STEPS = 1.0, 1200  # m; most depths that are tried
STEP_PX = 0.5  # of disparity, between them


def match(rig: StereoRig, views: dict[str, list[Grey]], left: Array, good: float) -> Array | None:
    """The right quad (4, 2) px that shows what a left quad (4, 2) shows, over all depths; None where none does."""
    focal = float(np.sqrt(rig.left.K[0, 0] * rig.left.K[1, 1]))
    most = focal * rig.baseline / NEAREST
    disparity = np.linspace(0.5, most, int(min(STEPS, most / STEP_PX)))
    rays = np.column_stack([left, np.ones(4)]) @ np.linalg.inv(rig.left.K).T
    depth = focal * rig.baseline / disparity
    quads = projected(rig.right.K, in_right(rig, rays[None] * depth[:, None, None]))
    size = views["right"][0].shape[1], views["right"][0].shape[0]
    usable = np.isfinite(quads).all(axis=(1, 2)) & np.all((quads > 0) & (quads < np.array(size) - 1), axis=(1, 2))
    if not usable.any():
        return None
    quads = quads[usable]
    here = patches.part_values(views["left"], left[None])[0]
    score = patches.correlations(patches.part_values(views["right"], quads), here)
    best = int(np.argmax(score))
    return np.asarray(quads[best]) if score[best] > good else None
