"""The particles of one front: begun along the line of sight, moved, weighed by what was measured. No pixels here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.facing import free
from visfuse_cli.facing.front import (
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
    middle,
    shape_of,
)
from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.maths import gaussian, particles
from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import triangulated
from visfuse_cli.records import Array, Gaussian, StereoRig
from visfuse_cli.vision.patches import log_height

LATELY_S, AHEAD = 0.5, 20.0  # of the looks that tell a course; how many times as far the course is thought to go on
ASTRAY = 0.9  # cosine of a course to the provisional way, below which that was wrong
AGAIN = 0.55  # of the effective number: below, the particles are drawn anew
JITTER = 0.5  # of the optimal kernel's width
FOUND_SHARE = 0.4  # how far the speed of what was found unaided may be off
DEPTH_PX = 0.5  # deviation of the disparity of quads that were given
USUAL_SIGMA, USUAL_DEPTH = 0.10, 20.0  # m/s a frame at 5 frames/s, of what is that far away (m) or farther
STRAYED = 60.0  # squared deviations of the cloud from the patch that was found
BLUR_PX, BLUR_STRETCH = 0.3, 0.01  # which is not thought of as strayed
USUAL = 4.0  # measurements that the stated noise stands for
LEAST_NOISE = 0.5
FREEDOM = 4.0  # of Student's t: how often a measurement is off by more than its noise
ROUNDS, STEP, NUGGET = (
    3,
    0.1,
    1e-6,
)  # of the proposal: iterations; deviations of its numerical derivative; of its variances


def speeds(
    speed: float | None, doubt: float | None, config: StereoConfig, count: int, rng: np.random.Generator
) -> Array:
    """Speeds (count,) m/s to begin with: either way along the path where the direction is not known.

    `doubt` (m/s): how far the speed of what was found unaided may be off; None where it was given.
    """
    if speed is None:
        return np.asarray(rng.uniform(-1, 1, count) * config.filter.start_speed)
    if doubt is not None:
        return np.asarray(rng.normal(speed, np.hypot(FOUND_SHARE * speed, doubt), count))
    sign = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    return np.asarray(sign * (speed + rng.normal(0, config.filter.speed_share * abs(speed), count)))


def depths(rig: StereoRig, depth: float, count: int, rng: np.random.Generator) -> Array:
    """By what shares (count,) a front at `depth` (m) may be farther off than its quads say."""
    return np.clip(rng.normal(0, depth / (rig.left.K[0, 0] * rig.baseline) * DEPTH_PX, count), -0.5, 0.5)


def along_sight(way: Way, state: Array, place: Array, depth: Array) -> Array:
    """States (P, 5) of a front at `state` (5,), place (3,) m, but by shares `depth` (P,) farther off."""
    states = np.tile(state, (len(depth), 1))
    places = place * (1 + depth[:, None])
    for _ in range(3):  # where the way bends, its axes are others there
        point, axes = way.frame(states[:, S])
        off = np.einsum("pab,pa->pb", axes, places - point)
        states[:, S] += off[:, 0]
        states[:, LATERAL], states[:, VERTICAL] = off[:, 1], off[:, 2]
    states[:, SIZE] = np.log1p(depth)
    return states


def predict(target: Target, t: float) -> None:
    """The particles to the time t (s): along the path by their speeds, drifting. Zhu 2012, eqs. 25-27."""
    dt = t - target.t
    if dt <= 0:
        return
    states = target.states
    target.t = t
    if target.free:
        noise = target.rng.normal(size=(len(states), 6))
        target.states = free.advanced(states, dt, sigma_v(target), target.free_drift, noise)
        return
    root = float(np.sqrt(5 * dt))  # the deviations belong to frames 0.2 s apart
    noise = target.rng.normal(size=(len(states), 3)) * root
    lateral, vertical = drift(target)
    states[:, S] += states[:, V] * dt
    states[:, V] += sigma_v(target) * noise[:, 0]
    states[:, LATERAL] += lateral * noise[:, 1]
    states[:, VERTICAL] += vertical * noise[:, 2]


def sigma_v(target: Target) -> float:
    """Deviation of the speed, m/s a frame at 5 frames/s; what is near and fills the picture is small, and slower."""
    if target.config.filter.sigma_v is not None:
        return target.config.filter.sigma_v
    depth = float(corners(target, target.mean)[:, 2].mean())
    return USUAL_SIGMA * float(np.clip(depth / USUAL_DEPTH, 1e-3, 1.0))


def forward(target: Target) -> NDArray[np.bool_]:
    """Which particles (P,) go along the path, not against it."""
    along = target.states[:, V]
    if target.free:
        along = target.states[:, free.VELOCITY] @ target.way.frame(np.array(0.0))[1][:, 0]
    return np.asarray(along >= 0)


def orient(target: Target) -> None:
    """Decide which way the vehicle goes, by what its particles' weights say."""
    ahead = forward(target)
    share = float(np.exp(target.log_weights[ahead]).sum())
    keep = ahead if share >= 0.5 else ~ahead
    target.log_weights = particles.normalised(np.where(keep, target.log_weights, -1e9))
    draw(target)
    target.oriented = True


def draw(target: Target, least: float = np.inf) -> None:
    """Draw the particles anew, a little apart from each other, where fewer than a share `least` are effective."""
    target.states, target.log_weights = particles.renewed(target.states, target.log_weights, target.rng, least, JITTER)


def take_in(target: Target) -> None:
    """Let the latest measurement tell the particles where to be: it is far sharper than they lie apart."""
    look, told = target.looks[-1], len(target.nis)
    expect = particles.moments(expected(target, target.states), target.log_weights)
    residual = look.z - expect.mean
    blur = np.diag([BLUR_PX**2, BLUR_PX**2, BLUR_STRETCH**2, BLUR_PX**2, BLUR_PX**2])
    if not residual @ np.linalg.solve(expect.cov + look.R + blur, residual) < STRAYED or astray(target):
        gather(target)
        return
    # The stated noise, made larger where the measurements so far were farther off than it allows.
    noise = max(LEAST_NOISE, (5 * USUAL + sum(target.nis)) / (5 * USUAL + 5 * told)) * look.R
    if len(target.looks) > 1:
        nis = float(residual @ np.linalg.solve(expect.cov + noise, residual))
        target.nis.append(nis)
        noise = noise * max(1.0, (FREEDOM + nis) / (FREEDOM + 5))
    whole, ahead = np.ones(len(target.states), dtype=bool), forward(target)
    both = [side for side in (ahead, ~ahead) if np.count_nonzero(side) > target.states.shape[1] + 1]
    sides = both if both and not target.oriented else [whole]
    clouds = [_posterior(target, side, noise) for side in sides]
    target.states = np.concatenate([states for states, _ in clouds])
    target.log_weights = particles.normalised(np.concatenate([weights for _, weights in clouds]))


def _posterior(target: Target, side: NDArray[np.bool_], noise: Array) -> tuple[Array, Array]:
    """Particles (P, n) of one direction of travel given the latest measurement, and their log weights."""
    z, log_weights = target.looks[-1].z, target.log_weights[side]
    top = log_weights.max()
    mass = float(top + np.log(np.exp(log_weights - top).sum()))
    prior = particles.moments(target.states[side], log_weights - mass)
    prior = Gaussian(prior.mean, prior.cov + NUGGET * np.diag(np.diag(prior.cov)) + 1e-12 * np.eye(len(prior.mean)))
    weight = np.linalg.inv(noise)

    def log_likelihood(states: Array) -> Array:
        off = z - expected(target, states)
        distance = np.einsum("pi,ij,pj->p", off, weight, off)
        return -0.5 * np.where(np.isfinite(distance), distance, 1e6)

    proposal = prior
    steps = STEP * np.sqrt(np.diag(prior.cov)) * np.eye(len(prior.mean))
    for _ in range(ROUNDS):  # the extended filter's iterations
        at = proposal.mean
        tried = expected(target, at + np.concatenate([0 * steps[:1], steps, -steps]))
        H = (tried[1 : len(at) + 1] - tried[len(at) + 1 :]).T / (2 * np.diag(steps))
        proposal, _ = gaussian.update(prior, z - tried[0] - H @ (prior.mean - at), H, noise)
    states, told, evidence = particles.imported(
        prior, proposal, log_likelihood, int(np.count_nonzero(side)), target.rng
    )
    return states, told + mass + evidence


def shift(target: Target, pixels: Array, stretch: float) -> None:
    """Let another point be the front's middle: `pixels` (2,) px aside in the left view; the front grows by a log."""
    depth = float(corners(target, target.mean)[:, 2].mean())
    aside = depth * np.append(pixels, 0.0) @ np.linalg.inv(target.rig.left.K).T
    if target.free:
        target.states[:, free.MIDDLE] += aside
    else:
        axes = target.way.frame(target.mean[S])[1]
        target.states[:, [S, LATERAL, VERTICAL]] += aside @ axes
    target.states[:, -1] += stretch


def gather(target: Target) -> None:
    """Put particles that have strayed where the patch was found, at the speed of the latest looks."""
    last = target.looks[-1]
    looks = [each for each in target.looks if each.t >= last.t - LATELY_S] if len(target.looks) > 2 else target.looks
    points = [triangulated(target.rig, each.z[:2], each.z[3:]) for each in (looks[0], last)]
    dt, moved, far = last.t - looks[0].t, points[1] - points[0], points[1][2]
    swift = float(np.hypot(0.2 * np.linalg.norm(moved), 0.01 * far)) / max(dt, 1e-3)
    if not target.on_path and not target.free:
        _turn(target, points)
    state = target.mean.copy()
    if target.free:
        state[free.MIDDLE] = points[1]
        state[free.VELOCITY] = moved / dt if dt else state[free.VELOCITY]
        sigma = np.array([0.002 * far, 0.002 * far, 0.01 * far, *[0.01] * 3, *[swift] * 3, *[0.05] * 3, 0.01])
    else:
        s = [target.way.nearest(point) for point in points]
        place, axes = target.way.frame(np.array(s[1]))
        off = (points[1] - place) @ axes
        state[[S, LATERAL, VERTICAL]] = s[1], off[1], off[2]
        state[V] = (s[1] - s[0]) / dt if dt else state[V]
        sigma = np.array([0.01 * far, swift, 0.002 * far, 0.002 * far, 0.01])
    state[-1] += last.z[2] - expected(target, state)[2]
    target.states = state + sigma * target.rng.normal(size=target.states.shape)
    target.log_weights = np.full(len(target.states), -np.log(len(target.states)))


def astray(target: Target) -> bool:
    """Whether what has no path of its own turns out to go elsewhere than was thought when it was found."""
    if target.on_path or target.free or len(target.looks) < 2:
        return False
    last = target.looks[-1]
    first = next(each for each in target.looks if each.t >= last.t - LATELY_S)
    points = [triangulated(target.rig, each.z[:2], each.z[3:]) for each in (first, last)]
    moved = points[1] - points[0]
    way, noise = float(np.linalg.norm(moved)), 0.01 * points[1][2]
    along = abs(target.way.frame(target.mean[S])[1][:, 0] @ moved)
    return bool(way > 5 * noise and along < ASTRAY * way)


def _turn(target: Target, points: list[Array]) -> None:
    """Lay a provisional way through two points (3,) m; the front keeps its place in space."""
    if np.linalg.norm(points[1] - points[0]) < NUGGET * points[1][2]:
        return
    before = target.way.frame(target.mean[S])[1]
    ahead = points[1] + AHEAD * (points[1] - points[0])
    target.way = Way(np.stack([points[0], ahead]))
    after = target.way.frame(np.array(0.0))[1]
    target.shape = Shape(target.shape.corners @ before.T @ after)


def again(target: Target, way: Way) -> Target:
    """The same measurements taken in once more along a way that is known now, from the first one on."""
    count, first = len(target.states), target.looks[0]
    place = triangulated(target.rig, first.z[:2], first.z[3:])
    shape, state = shape_of(target.rig, way, first.quads["left"], float(place[2]), FACING_FOUND)
    states = along_sight(way, state, middle(way, state), depths(target.rig, float(place[2]), count, target.rng))
    before = target.causal[0][2]
    states[:, V] = target.rng.normal(before.mean[V], np.sqrt(before.cov[V, V]), count)
    even = np.full(count, -np.log(count))
    other = replace(
        target, way=way, shape=shape, states=states, log_weights=even, t=first.t, on_path=True, looks=[], nis=[]
    )
    other.causal, looks = [], {look.frame: look for look in target.looks}
    for frame, t, _, seen in target.causal:
        predict(other, t)
        if seen:
            other.looks.append(looks[frame])
            take_in(other)
        other.causal.append((frame, t, particles.moments(other.states, other.log_weights), seen))
        draw(other, AGAIN)
        if seen:  # the patch was moved and stretched after it was measured
            quad, z = looks[frame].quads["left"], looks[frame].z
            shift(other, quad.mean(axis=0) - z[:2], float(log_height(quad) - z[2]))
    return other
