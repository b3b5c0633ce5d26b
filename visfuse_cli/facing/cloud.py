"""The particles of one front: begun along the line of sight, moved, weighed by what was measured. No pixels here."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.facing import free
from visfuse_cli.facing.front import LATERAL, SIZE, VERTICAL, S, Target, V, corners, drift, expected
from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.maths import gaussian, particles
from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import triangulated
from visfuse_cli.records import Array, Gaussian

AGAIN = 0.55  # of the effective number: below, the particles are drawn anew
JITTER = 0.5  # of the optimal kernel's width
FOUND_SHARE = 0.4  # how far the speed of what was found unaided may be off
DEPTH_PX = 0.5  # deviation of the disparity of quads that were given
USUAL_SIGMA = 0.15  # m/s a frame at 5 frames/s
STRAYED = 60.0  # squared deviations of the cloud from the patch that was found
BLUR_PX, BLUR_STRETCH = 0.3, 0.01  # which is not thought of as strayed
USUAL = 4.0  # measurements that the stated noise stands for
LEAST_NOISE = 0.5
ROUNDS, STEP, NUGGET = (
    3,
    0.1,
    1e-6,
)  # of the proposal: iterations; deviations of its numerical derivative; of its variances


def speeds(speed: float | None, given: bool, config: StereoConfig, count: int, rng: np.random.Generator) -> Array:
    """Speeds (count,) m/s to begin with: either way along the path where the direction is not known."""
    if speed is None:
        return np.asarray(rng.uniform(-1, 1, count) * config.filter.start_speed)
    if not given:
        return np.asarray(speed * (1 + FOUND_SHARE * rng.normal(size=count)))
    sign = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    return np.asarray(sign * (speed + rng.normal(0, config.filter.speed_share * abs(speed), count)))


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
    settings, states = target.config.filter, target.states
    target.t = t
    if target.free:
        noise = target.rng.normal(size=(len(states), 6))
        target.states = free.advanced(states, dt, settings.sigma_v or USUAL_SIGMA, target.free_drift, noise)
        return
    root = float(np.sqrt(5 * dt))  # the deviations belong to frames 0.2 s apart
    noise = target.rng.normal(size=(len(states), 3)) * root
    lateral, vertical = drift(target)
    states[:, S] += states[:, V] * dt
    states[:, V] += (settings.sigma_v or USUAL_SIGMA) * noise[:, 0]
    states[:, LATERAL] += lateral * noise[:, 1]
    states[:, VERTICAL] += vertical * noise[:, 2]


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
    if not residual @ np.linalg.solve(expect.cov + look.R + blur, residual) < STRAYED:
        gather(target)
        return
    # The stated noise, made larger where the measurements so far were farther off than it allows.
    noise = max(LEAST_NOISE, (5 * USUAL + sum(target.nis)) / (5 * USUAL + 5 * told)) * look.R
    if len(target.looks) > 1:
        target.nis.append(float(residual @ np.linalg.solve(expect.cov + noise, residual)))
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
