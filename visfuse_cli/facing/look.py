"""Looking at a front: its patch aligned in both views from where it is expected, its pieces found in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from visfuse_cli.facing import cloud
from visfuse_cli.facing.front import Looked, Target, corners, left_quad
from visfuse_cli.maths.planes import in_right, projected, triangulated
from visfuse_cli.records import Array
from visfuse_cli.vision import patches
from visfuse_cli.vision.patches import Alignment, Grey

TRUST = 8.0  # times an alignment's own covariance: neighbouring samples share their errors
ACROSS_STRETCH = 0.03  # what a front that is not quite flat, or not quite so turned, differs by across the views
SETTLE_S, ALIKE_SIZE = 1.0, 0.7  # of a patch found unaided on the region that moves; largest log of their sizes' ratio
SURE = 0.8  # correlation
FLOOR_PX, FLOOR_STRETCH = 0.02, 0.0015


def look(target: Target, views: dict[str, list[Grey]], at: tuple[int, float]) -> bool:
    """Align the patch in both views, from where the particles and where its own motion put it; whether it was seen."""
    size = views["left"][0].shape[1], views["left"][0].shape[0]
    best: tuple[Alignment, Array] | None = None
    for quad in (left_quad(target), _continued(target, at[1])):
        if quad is None or not patches.inside(quad, size):
            continue
        found = patches.align(views["left"], quad, target.sought, shape=patches.KEPT)
        if found is not None and (best is None or found.correlation > best[0].correlation):
            best = (found, found.quad(quad))
    if best is None or best[0].correlation < target.config.observation.good:
        return False
    return measured(target, views, at, *best, _right_of(target, best[1]))


def _continued(target: Target, t: float) -> Array | None:
    """The left quad if shift and growth go on as between the last two looks; None where there are fewer."""
    if len(target.looks) < 2:
        return None
    before, last = target.looks[-2:]
    share = (t - last.t) / (last.t - before.t)
    tall = np.exp(last.z[2] + np.clip(share * (last.z[2] - before.z[2]), -0.5, 0.5))
    moved = last.z[:2] + share * (last.z[:2] - before.z[:2])
    usual = left_quad(target) if target.on_path else last.quads["left"]
    return np.asarray(moved + tall / np.exp(patches.log_height(usual)) * (usual - usual.mean(axis=0)))


def _right_of(target: Target, left: Array) -> Array:
    """Where the right view should show a left quad (4, 2): as much nearer than at the last look as it has grown."""
    rig, last = target.rig, target.looks[-1] if target.looks else None
    depth = corners(target, target.mean)[:, 2]
    if last is not None:
        before = triangulated(rig, last.z[:2], last.z[3:])[2]
        depth = depth / depth.mean() * before * np.exp(last.z[2] - patches.log_height(left))
    rays = np.column_stack([left, np.ones(4)]) @ np.linalg.inv(rig.left.K).T
    return projected(rig.right.K, in_right(rig, rays * depth[:, None]))


def moved_across(views: dict[str, list[Grey]], left: Array, right: Array) -> Array:
    """The right quad (4, 2) px moved to where the left one's patch is; as it was where it cannot be told.

    Quads drawn by hand tell the depth to a few per cent: on a bend, that turns the front by degrees.
    """
    found = patches.align(views["right"], right, patches.template(views["left"], left), ACROSS_STRETCH, patches.KEPT)
    return right if found is None or found.correlation < SURE else found.quad(right)


def measured(
    target: Target,
    views: dict[str, list[Grey]],
    at: tuple[int, float],
    found: Alignment,
    left: Array,
    right: Array,
) -> bool:
    """Align the left view's present patch in the right one, and keep what both say."""
    present = patches.template(views["left"], left)
    size = views["left"][0].shape[1], views["left"][0].shape[0]
    if not patches.inside(right, size):
        return False
    across = patches.align(views["right"], right, present, ACROSS_STRETCH, patches.KEPT)
    if across is None or across.correlation < target.config.observation.good:
        return False
    right = across.quad(right)
    R = np.zeros((5, 5))
    R[:3, :3] = TRUST * found.cov[:3, :3] + np.diag([FLOOR_PX**2, FLOOR_PX**2, FLOOR_STRETCH**2])
    # The right middle was found from the left one: an error of the left is shared, and the search adds its own.
    R[3:, 3:] = R[:2, :2] + TRUST * across.cov[:2, :2] + FLOOR_PX**2 * np.eye(2)
    R[3:, :3], R[:3, 3:] = R[:2, :3], R[:3, :2]
    seen, quads = target.pieces.look(views, {"left": left, "right": right})
    # The pieces carry errors of their first sight on; what is beside the left patch now was searched afresh.
    middle = quads["left"].mean(axis=0)
    across = right.mean(axis=0) + middle - left.mean(axis=0)
    z = np.concatenate([middle, [patches.log_height(quads["left"])], across])
    target.looks.append(Looked(*at, z, R, quads, found.correlation, seen))
    return True


def take_over(target: Target, views: dict[str, list[Grey]]) -> None:
    """Let the reference follow what is seen, the first one staying in it. Zhu 2012, eq. 14."""
    settings = target.config.observation
    fresh = patches.part_values(views["left"], target.looks[-1].quads["left"][None], settings.parts)[0]
    old, first = settings.epsilon, settings.first_share
    mixed = first * target.first + (1 - first) * (old * target.reference + (1 - old) * fresh)
    mixed = mixed - mixed.mean()
    target.reference = mixed / max(float(mixed.std()), 1e-3)


def settle_on(target: Target, views: dict[str, list[Grey]], region: Array, dt: float) -> None:
    """Let the patch drift to the middle of the region (4, 2) px that moves, dt (s) after the last time.

    What turns shows new sides: a patch that kept to the old ones would leave the vehicle with them.
    """
    look = target.looks[-1]
    left = look.quads["left"]
    size, asked = np.array(patches.side(left)), np.array(patches.side(region))
    shift = region.mean(axis=0) - left.mean(axis=0)
    if np.any(np.abs(shift) > 0.5 * asked) or np.any(np.abs(np.log(asked / size)) > ALIKE_SIZE):
        return
    share = 1 - np.exp(-dt / SETTLE_S)
    stretch = np.exp(share * float(np.log(asked / size).mean()))
    quads = {}
    for view, quad in look.quads.items():
        middle = quad.mean(axis=0)
        quads[view] = middle + share * shift + stretch * (quad - middle)
    if all(patches.inside(quads[view], (views[view][0].shape[1], views[view][0].shape[0])) for view in quads):
        target.looks[-1] = replace(look, quads=quads)
        target.sought = patches.template(views["left"], quads["left"])
        target.pieces.moved(look.quads, quads)
        cloud.shift(target, share * shift, float(np.log(stretch)))
