"""One vehicle's front followed by particles over its pose along the path, weighed by both views."""

from __future__ import annotations

import numpy as np

from visfuse_cli.facing import cloud, free
from visfuse_cli.facing.front import (
    FACING,
    FACING_FOUND,
    Shape,
    Target,
    corners,
    middle,
    place_of,
    quads_of,
    shape_of,
)
from visfuse_cli.facing.look import look, measured, moved_across, take_over
from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.maths import particles
from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import in_right, projected
from visfuse_cli.records import Array, StereoRig
from visfuse_cli.vision import patches
from visfuse_cli.vision.patches import Alignment, Grey

SIGN_FRAMES = 2  # frames after which the direction of travel is decided
SHOWN = 60  # particles that are drawn


def start(
    identity: int,
    rig: StereoRig,
    way: Way,
    config: StereoConfig,
    views: dict[str, list[Grey]],
    quads: tuple[Array, Array],
    speed: float | None,
    at: tuple[int, float],
    seed: int,
    doubt: float | None,
    on_path: bool,
) -> Target | None:
    """Begin with a front seen in left and right quads (4, 2) px at (frame, t); None where it is behind the cameras.

    `doubt` (m/s): how far `speed` may be off where the front was found unaided; None where it was given.
    """
    (left, right), given = quads, doubt is None
    right = moved_across(views, left, right)
    place = place_of(rig, left, right)
    if place is None:
        return None
    rng = np.random.default_rng((seed, identity))
    shape, state = shape_of(rig, way, left, float(place[2]), FACING if given else FACING_FOUND)
    depth = cloud.depths(rig, float(place[2]), config.filter.particles, rng)
    speeds = cloud.speeds(speed, doubt, config, config.filter.particles, rng)
    pace, unbound = abs(speed or config.filter.start_speed), not config.filter.path_constraint
    if unbound:
        shape, states = _unbound(way, shape, state, depth, speeds, config.filter.free_share * pace, rng)
    else:
        states = cloud.along_sight(way, state, middle(way, state), depth)
        states[:, 1] = speeds
    cells = patches.part_values(views["left"], left[None], config.observation.parts)[0]
    target = Target(
        id=identity,
        rig=rig,
        way=way,
        shape=shape,
        config=config,
        rng=rng,
        states=states,
        log_weights=np.full(len(states), -np.log(len(states))),
        sought=patches.template(views["left"], left),
        first=cells,
        reference=cells,
        t=at[1],
        given=given,
        on_path=on_path,
        free_drift=config.filter.free_share * 0.2 * pace,
        oriented=speed is not None and not given,
        free=unbound,
        last_seen=at[1],
    )
    # The given right quad says how far away the front is; where it is exactly, the pictures say.
    seen = projected(rig.right.K, in_right(rig, corners(target, target.mean)))
    if measured(target, views, at, Alignment(np.zeros(2), np.zeros(2), np.zeros((4, 4)), 1.0), left, seen):
        cloud.take_in(target)
    target.causal.append((*at, particles.moments(target.states, target.log_weights), bool(target.looks)))
    return target


def _unbound(
    way: Way, shape: Shape, state: Array, depth: Array, speeds: Array, drift: float, rng: np.random.Generator
) -> tuple[Shape, Array]:
    """The front's shape in space, and particles of six degrees of freedom that go along the way, more or less."""
    axes = way.frame(state[0])[1]
    aside = drift * rng.normal(size=(len(depth), 2))
    velocity = speeds[:, None] * axes[:, 0] + aside @ axes[:, 1:].T * [1.0, 0.5, 1.0]
    return Shape(shape.corners @ axes.T), free.started(middle(way, state), depth, velocity)


def update(target: Target, views: dict[str, list[Grey]], at: tuple[int, float]) -> None:
    """Weigh the particles by both views, then align the patch from where they agree."""
    before, said = target.log_weights, _likelihood(target, views)
    target.log_weights = particles.normalised(before + said)
    if not target.oriented and len(target.causal) >= SIGN_FRAMES:
        cloud.orient(target)
        before, said = target.log_weights, np.zeros(len(before))
    seen = look(target, views, at)
    if seen:
        target.last_seen = at[1]
        # The aligned patch has seen the same pixels, and sharper: what the parts say beyond a first share is in it.
        share = particles.bearable(before, said, 0.5)
        target.log_weights = particles.normalised(before + share * said)
        cloud.take_in(target)
        take_over(target, views)
        if target.looks[-1].correlation < target.config.observation.fresh:
            target.sought = patches.template(views["left"], target.looks[-1].quads["left"])
    belief = particles.moments(target.states, target.log_weights)
    target.causal.append((*at, belief, seen))
    shown = target.states[:: max(1, len(target.states) // SHOWN)]
    target.clouds[at[0]] = corners(target, shown).mean(axis=1)
    cloud.draw(target, cloud.AGAIN)


def _likelihood(target: Target, views: dict[str, list[Grey]]) -> Array:
    """Log likelihood (P,) of the particles: parts in either view, correlation across. Zhu 2012, eqs. 13, 17-18."""
    quads = quads_of(target, target.states)
    settings = target.config.observation
    seen = (views["left"], views["right"]), (quads["left"], quads["right"])
    distance, across = patches.observed(*seen, target.reference, settings.parts)
    bad = ~np.isfinite(quads["left"]).all(axis=(1, 2)) | ~np.isfinite(quads["right"]).all(axis=(1, 2))
    return np.where(bad, -1e6, -settings.lambda_d * distance + settings.lambda_c * across)
