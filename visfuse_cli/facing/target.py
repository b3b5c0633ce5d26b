"""One vehicle's front followed by particles over its pose along the path, weighed by both views."""

from __future__ import annotations

import numpy as np

from visfuse_cli.facing import free
from visfuse_cli.facing.front import (
    FACING,
    FACING_FOUND,
    LATERAL,
    SIZE,
    VERTICAL,
    S,
    Shape,
    Target,
    V,
    corners,
    drift,
    expected,
    quads_of,
    shape_of,
)
from visfuse_cli.facing.look import look, measured, take_over
from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.maths import particles
from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import in_right, projected, triangulated
from visfuse_cli.records import Array, StereoRig
from visfuse_cli.vision import patches
from visfuse_cli.vision.patches import Alignment, Grey

AGAIN = 0.55  # of the effective number: below, the particles are drawn anew
SIGN_FRAMES = 2  # frames after which the direction of travel is decided
FOUND_SHARE = 0.4  # how far the speed of what was found unaided may be off
STRAYED = 60.0  # squared deviations of the best particle from the patch that was found
TEMPER = 4.0
SHOWN = 60  # particles that are drawn
BLUR_PX, BLUR_STRETCH = 0.3, 0.01


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
    given: bool,
    on_path: bool,
) -> Target | None:
    """Begin with a front seen in left and right quads (4, 2) px at (frame, t); None where it is behind the cameras."""
    left, right = quads
    place = triangulated(rig, left.mean(axis=0), right.mean(axis=0))
    if not np.isfinite(place).all() or place[2] <= 0.1:
        return None
    shape, state = shape_of(rig, way, left, float(place[2]), FACING if given else FACING_FOUND)
    rng = np.random.default_rng((seed, identity))
    count, unbound = config.filter.particles, not config.filter.path_constraint
    sigma_depth = place[2] ** 2 / (rig.left.K[0, 0] * rig.baseline) * 0.5
    depth = np.clip(rng.normal(0, sigma_depth / place[2], count), -0.5, 0.5)
    speeds = _first_speeds(speed, given, config, count, rng)
    point, axes = way.frame(state[S])
    if unbound:
        middle_ = point + axes[:, 1] * state[LATERAL] + axes[:, 2] * state[VERTICAL]
        shape = Shape(shape.corners @ axes.T)
        states = free.started(middle_, depth, speeds[:, None] * axes[:, 0])
    else:
        states = np.tile(state, (count, 1))
        states[:, S] += depth * place[2]
        states[:, V], states[:, SIZE] = speeds, depth
    cells = patches.part_values(views["left"], left[None], config.observation.parts)[0]
    target = Target(
        id=identity,
        rig=rig,
        way=way,
        shape=shape,
        config=config,
        rng=rng,
        states=states,
        log_weights=np.full(count, -np.log(count)),
        sought=patches.template(views["left"], left),
        first=cells,
        reference=cells,
        t=at[1],
        given=given,
        on_path=on_path,
        free_drift=config.filter.free_share * 0.2 * abs(speed or config.filter.start_speed),
        oriented=speed is not None and not given,
        free=unbound,
        last_seen=at[1],
    )
    # The given right quad says how far away the front is; where it is exactly, the pictures say.
    seen = projected(rig.right.K, in_right(rig, corners(target, target.mean)))
    measured(target, views, at, Alignment(np.zeros(2), np.zeros(2), np.zeros((4, 4)), 1.0), left, seen)
    target.causal.append((*at, particles.moments(states, target.log_weights), bool(target.looks)))
    return target


def _first_speeds(
    speed: float | None, given: bool, config: StereoConfig, count: int, rng: np.random.Generator
) -> Array:
    """Speeds (count,) m/s to begin with: either way along the path where the direction is not known."""
    if speed is None:
        return np.asarray(rng.uniform(-1, 1, count) * config.filter.start_speed)
    if not given:
        return np.asarray(speed * (1 + FOUND_SHARE * rng.normal(size=count)))
    sign = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    return np.asarray(sign * (speed + rng.normal(0, config.filter.speed_share * abs(speed), count)))


def predict(target: Target, t: float) -> None:
    """The particles to the time t (s): along the path by their speeds, drifting. Zhu 2012, eqs. 25-27."""
    dt = t - target.t
    if dt <= 0:
        return
    settings, states = target.config.filter, target.states
    target.t = t
    if target.free:
        noise = target.rng.normal(size=(len(states), 6))
        target.states = free.advanced(states, dt, settings.sigma_v or 0.15, target.free_drift, noise)
        return
    root = float(np.sqrt(5 * dt))  # the deviations belong to frames 0.2 s apart
    noise = target.rng.normal(size=(len(states), 3)) * root
    lateral, vertical = drift(target)
    states[:, S] += states[:, V] * dt
    states[:, V] += (settings.sigma_v or 0.15) * noise[:, 0]
    states[:, LATERAL] += lateral * noise[:, 1]
    states[:, VERTICAL] += vertical * noise[:, 2]


def update(target: Target, views: dict[str, list[Grey]], at: tuple[int, float]) -> None:
    """Weigh the particles by both views, then align the patch from where they agree."""
    quads = quads_of(target, target.states)
    settings = target.config.observation
    values = {view: patches.part_values(views[view], quads[view], settings.parts) for view in ("left", "right")}
    distance = sum((patches.part_distance(each, target.reference) for each in values.values()), np.zeros(1))
    across = patches.correlations(values["left"], values["right"])
    log_likelihood = -settings.lambda_d * distance + settings.lambda_c * across  # Zhu 2012, eqs. 13, 17-18, in logs
    bad = ~np.isfinite(quads["left"]).all(axis=(1, 2)) | ~np.isfinite(quads["right"]).all(axis=(1, 2))
    weights = target.log_weights + np.where(bad, -1e6, log_likelihood)
    target.log_weights = particles.normalised(weights)
    if not target.oriented and len(target.causal) >= SIGN_FRAMES:
        _orient(target)
    seen = look(target, views, at)
    if seen:
        target.last_seen = at[1]
        _pull(target)
        take_over(target, views)
        if target.looks[-1].correlation < target.config.observation.fresh:
            target.sought = patches.template(views["left"], target.looks[-1].quads["left"])
    belief = particles.moments(target.states, target.log_weights)
    target.causal.append((*at, belief, seen))
    shown = target.states[:: max(1, len(target.states) // SHOWN)]
    target.clouds[at[0]] = corners(target, shown).mean(axis=1)
    if particles.effective_number(target.log_weights) < AGAIN * len(target.states):
        _draw(target, target.log_weights)


def _orient(target: Target) -> None:
    """Decide which way the vehicle goes, by what its particles' weights say."""
    along = target.states[:, V]
    if target.free:
        along = target.states[:, free.VELOCITY] @ target.way.frame(np.array(0.0))[1][:, 0]
    ahead = along >= 0
    share = float(np.exp(target.log_weights[ahead]).sum())
    keep = ahead if share >= 0.5 else ~ahead
    _draw(target, particles.normalised(np.where(keep, target.log_weights, -1e9)))
    target.oriented = True


def _draw(target: Target, log_weights: Array) -> None:
    """Draw the particles anew, a little apart from each other."""
    index = particles.systematic(log_weights, target.rng)
    target.log_weights = np.full(len(index), -np.log(len(index)))
    target.states = particles.regularised(target.states[index], target.log_weights, target.rng, 0.5)


def _gather(target: Target) -> None:
    """Put particles that have strayed where the patch was found, at the speed between the last two looks."""
    looks, way = target.looks[-2:], target.way
    points = [triangulated(target.rig, each.z[:2], each.z[3:]) for each in looks]
    dt = looks[-1].t - looks[0].t
    state, far = target.mean.copy(), points[-1][2]
    if target.free:
        state[free.MIDDLE] = points[-1]
        state[free.VELOCITY] = (points[-1] - points[0]) / dt if dt else state[free.VELOCITY]
        swift = 0.2 * float(np.linalg.norm(state[free.VELOCITY]))
        sigma = np.array([0.002 * far, 0.002 * far, 0.01 * far, *[0.01] * 3, *[swift] * 3, *[0.05] * 3, 0.01])
    else:
        s = [way.nearest(point) for point in points]
        place, axes = way.frame(np.array(s[-1]))
        off = (points[-1] - place) @ axes
        state[[S, LATERAL, VERTICAL]] = s[-1], off[1], off[2]
        state[V] = (s[-1] - s[0]) / dt if dt else 0.0
        sigma = np.array([0.01 * far, 0.2 * abs(state[V]), 0.002 * far, 0.002 * far, 0.01])
    state[-1] += looks[-1].z[2] - expected(target, state)[2]
    target.states = state + sigma * target.rng.normal(size=target.states.shape)
    target.log_weights = np.full(len(target.states), -np.log(len(target.states)))


def _pull(target: Target) -> None:
    """Weigh the particles by the latest measurement too, tempered: the parts have seen the same pixels already."""
    look = target.looks[-1]
    residual = look.z - expected(target, target.states)
    spread = TEMPER * look.R + np.diag([BLUR_PX**2, BLUR_PX**2, BLUR_STRETCH**2, BLUR_PX**2, BLUR_PX**2])
    distance = np.einsum("pi,ij,pj->p", residual, np.linalg.inv(spread), residual)
    distance = np.where(np.isfinite(distance), distance, 1e6)
    if distance.min() > STRAYED:
        _gather(target)
        return
    target.log_weights = particles.normalised(target.log_weights - 0.5 * distance)
