"""How things move on the ground, in one shape for every motion model the tracker knows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from visfuse_cli.maths import fading, gaussian, motion
from visfuse_cli.maths.angles import wrap, wrap_at
from visfuse_cli.records import Array, Gaussian, Innovation
from visfuse_cli.tracking.settings import FilterSettings, TargetSettings

WHEELBASE_SHARE = 0.6  # of a vehicle's length


@dataclass(frozen=True, slots=True)
class Dynamics:
    """A motion model ready for the tracker: states x (n,), measurements z = H x (m,) of which some are angles."""

    H: Array
    alpha: tuple[float, ...]  # weights of the fading factor (m,)
    angles_z: tuple[int, ...]
    angles_x: tuple[int, ...]
    advance: Callable[[Array, Array, Array], tuple[Array, Array, Array]]  # x, dt, length (N, ...) -> x', F, Q
    begin: Callable[[Array, Array], Gaussian]  # pose (3,), velocity (2,) -> belief
    planar: Callable[[Array], tuple[Array, Array]]  # x (..., n) -> (X, Y, X', Y') and its Jacobian (..., 4, n)
    heading: Callable[[Array], Array]  # x (..., n) -> rad (...)
    measured: Callable[[Array, Array], tuple[Array, Array]]  # pose (3,), cov (3, 3) -> z, R
    adaptive: bool  # fading factor in use


@dataclass(frozen=True, slots=True)
class Prediction:
    """Where N targets are expected: prior (N, n), transitions F (N, n, n) and the noise Q (N, n, n) in the prior."""

    prior: Gaussian
    F: Array
    Q: Array

    def __getitem__(self, k: int) -> Prediction:
        return Prediction(Gaussian(self.prior.mean[k], self.prior.cov[k]), self.F[k], self.Q[k])


@dataclass(frozen=True, slots=True)
class Step:
    """One filter step of one target: prior, posterior, the transition to it, and what the measurement said (if any)."""

    prior: Gaussian
    posterior: Gaussian
    F: Array
    innovation: Innovation | None
    memory: fading.FadingState | None


def for_target(target: TargetSettings, filter_: FilterSettings) -> Dynamics:
    """The dynamics that a configuration asks for: the bicycle (Lou 2002, eq. 1) or constant velocity."""
    adaptive = filter_.kind == "fading"
    if target.motion == "bicycle":
        return _bicycle(filter_, adaptive)
    return _constant_velocity(filter_, adaptive)


def _bicycle(filter_: FilterSettings, adaptive: bool) -> Dynamics:
    def advance(x: Array, dt: Array, length: Array) -> tuple[Array, Array, Array]:
        wheelbase = WHEELBASE_SHARE * length
        following, F = motion.bicycle(x, dt, wheelbase)
        return following, F, motion.bicycle_noise(x, dt, wheelbase, filter_.sigma_a, filter_.sigma_steer)

    def begin(pose: Array, velocity: Array) -> Gaussian:
        speed = float(velocity @ [np.cos(pose[2]), np.sin(pose[2])])  # negative: it reverses
        mean = np.array([pose[0], pose[1], speed, pose[2], 0.0])
        return Gaussian(mean, np.diag([0.5, 0.5, max(1.5, 0.3 * abs(speed)), 0.2, 0.1]) ** 2)

    def planar(x: Array) -> tuple[Array, Array]:
        velocity, J = motion.bicycle_velocity(x)
        position = np.eye(2, 5)
        return np.concatenate([x[..., :2], velocity], axis=-1), np.concatenate(
            [np.broadcast_to(position, (*J.shape[:-2], 2, 5)), J], axis=-2
        )

    return Dynamics(
        H=motion.BICYCLE_MEASUREMENT,
        alpha=fading.ALPHA,
        angles_z=(2,),
        angles_x=(3,),
        advance=advance,
        begin=begin,
        planar=planar,
        heading=lambda x: x[..., 3],
        measured=lambda pose, cov: (pose, cov),
        adaptive=adaptive,
    )


def _constant_velocity(filter_: FilterSettings, adaptive: bool) -> Dynamics:
    def advance(x: Array, dt: Array, length: Array) -> tuple[Array, Array, Array]:
        F = motion.constant_velocity(dt)
        return gaussian.times(F, x), F, motion.constant_velocity_noise(dt, filter_.sigma_a**2)

    def begin(pose: Array, velocity: Array) -> Gaussian:
        return Gaussian(np.concatenate([pose[:2], velocity]), np.diag([0.3, 0.3, 0.8, 0.8]) ** 2)

    return Dynamics(
        H=np.eye(2, 4),
        alpha=(1.0, 1.0),
        angles_z=(),
        angles_x=(),
        advance=advance,
        begin=begin,
        planar=lambda x: (x, np.broadcast_to(np.eye(4), (*x.shape[:-1], 4, 4))),
        heading=lambda x: np.arctan2(x[..., 3], x[..., 2]),
        measured=lambda pose, cov: (pose[:2], cov[:2, :2]),
        adaptive=adaptive,
    )


def predict(dynamics: Dynamics, beliefs: Sequence[Gaussian], dt: Array, length: Array) -> Prediction:
    """Advance N beliefs by dt (N,) s; length (N,) m is each target's own."""
    mean, F, Q = dynamics.advance(np.stack([belief.mean for belief in beliefs]), dt, length)
    cov = gaussian.propagate(np.stack([belief.cov for belief in beliefs]), F, Q)
    return Prediction(Gaussian(mean, cov), F, Q)


def coast(prediction: Prediction, memory: fading.FadingState | None) -> Step:
    """The step of a target that was not measured."""
    return Step(prediction.prior, prediction.prior, prediction.F, None, memory)


def residual(dynamics: Dynamics, z: Array, x: Array) -> Array:
    """z - H x with angles wrapped; a box turned by half a turn is the same box."""
    difference = z - gaussian.times(dynamics.H, x)
    for index in dynamics.angles_z:
        difference[..., index] = wrap(2 * difference[..., index]) / 2
    return difference


def take(dynamics: Dynamics, prediction: Prediction, z: Array, R: Array, memory: fading.FadingState | None) -> Step:
    """Take in one target's measurement (Lou 2002, eqs. 5-11); `memory` is the fading filter's record of residuals."""
    gamma = residual(dynamics, z, prediction.prior.mean)
    if memory is None:
        memory = fading.start(prediction.prior, dynamics.H, R)
    limit = fading.LIMIT if dynamics.adaptive else 1.0
    taken = fading.update(prediction.prior, prediction.Q, gamma, dynamics.H, R, memory, dynamics.alpha, limit=limit)
    posterior = Gaussian(wrap_at(taken.posterior.mean, dynamics.angles_x), taken.posterior.cov)
    return Step(taken.prior, posterior, prediction.F, taken.innovation, taken.state)
