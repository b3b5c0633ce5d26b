"""Motion models: the step over dt with its Jacobian, and continuous noise, so that splitting a step changes nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from visfuse_cli.maths.angles import wrap
from visfuse_cli.maths.gaussian import symmetrise, transpose
from visfuse_cli.records import Array

STEERING_LIMIT = 0.7  # rad; no road car's wheels turn further, and tan(phi) stays below 0.85
BICYCLE_MEASUREMENT = np.array([[1.0, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 0, 1, 0]])  # Lou 2002, eq. 2
# Three Gauss points integrate polynomials of degree 5; on a straight path the bicycle's noise needs degree 4.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(3)


def constant_velocity(dt: ArrayLike, dims: int = 2) -> Array:
    """F (..., 2 dims, 2 dims) over dt (...) s for the state [position (dims), velocity (dims)]. Jia 2008, eq. 19."""
    dt = np.asarray(dt, dtype=float)
    one = np.ones_like(dt)
    return _each_axis([[one, dt], [0 * dt, one]], dims)


def constant_velocity_noise(dt: ArrayLike, q: ArrayLike, dims: int = 2) -> Array:
    """Q (..., 2 dims, 2 dims) of white acceleration with density q (m^2 s^-3) over dt (...) s."""
    dt, q = np.broadcast_arrays(np.asarray(dt, dtype=float), np.asarray(q, dtype=float))
    return _each_axis([[q * dt**3 / 3, q * dt**2 / 2], [q * dt**2 / 2, q * dt]], dims)


def _each_axis(block: list[list[Array]], dims: int) -> Array:
    """A block of order p, its entries (...), repeated for every axis: (..., p dims, p dims)."""
    matrix = np.stack([np.stack(row, axis=-1) for row in block], axis=-2)
    size = len(block) * dims
    return np.einsum("...ij,kl->...ikjl", matrix, np.eye(dims)).reshape(*matrix.shape[:-2], size, size)


def bicycle(x: Array, dt: ArrayLike, wheelbase: ArrayLike) -> tuple[Array, Array]:
    """The car (..., 5) after dt (...) s with v and phi constant, and the Jacobian (..., 5, 5). Lou 2002, eq. 1.

    State [x, y, v, theta, phi]: the centre between the axles (m), the rear wheel's speed (m/s, negative in reverse),
    heading and steering angle (rad); wheelbase (...) m. phi is cut at STEERING_LIMIT, where the Jacobian is the inner
    side's, so that a filter at the limit can still turn back. Exact: the rear axle runs along a circle.
    """
    v, theta, phi = x[..., 2], x[..., 3], np.clip(x[..., 4], -STEERING_LIMIT, STEERING_LIMIT)
    dt, wheelbase = np.asarray(dt, dtype=float), np.asarray(wheelbase, dtype=float)
    tau = np.tan(phi)
    way, turn = v * dt, v * dt * tau / wheelbase
    chord, chord_slope = _sinc(turn / 2)
    along, across = _axes(theta + turn / 2)
    # The rear axle's chord plus the turn of the half wheelbase ahead of it; both point along or across mid-heading.
    course = along + (tau / 2)[..., None] * across
    course_turned = across - (tau / 2)[..., None] * along
    moved = (way * chord)[..., None] * course
    by_turn = way[..., None] * ((chord_slope / 2)[..., None] * course + (chord / 2)[..., None] * course_turned)

    tau_slope = 1 + tau**2
    F = np.zeros((*moved.shape[:-1], 5, 5))
    F[..., range(5), range(5)] = 1
    F[..., :2, 2] = (dt * chord)[..., None] * course + by_turn * (dt * tau / wheelbase)[..., None]
    F[..., :2, 3] = (way * chord)[..., None] * course_turned
    by_steering = (way * chord / 2)[..., None] * across + by_turn * (way / wheelbase)[..., None]
    F[..., :2, 4] = tau_slope[..., None] * by_steering
    F[..., 3, 2] = dt * tau / wheelbase
    F[..., 3, 4] = way * tau_slope / wheelbase
    x_next = np.empty(F.shape[:-1])
    x_next[..., :2] = x[..., :2] + moved
    x_next[..., 2], x_next[..., 3], x_next[..., 4] = v, wrap(theta + turn), phi
    return x_next, F


def bicycle_noise(x: Array, dt: ArrayLike, wheelbase: ArrayLike, sigma_a: ArrayLike, sigma_steer: ArrayLike) -> Array:
    """Q (..., 5, 5) over dt (...) s from white acceleration and white steering rate, carried through the motion.

    x (..., 5) is the state at the start; sigma_a (m/s^2 per root Hz) and sigma_steer (rad/s per root Hz) are the
    square roots of the spectral densities of a and b in Lou 2002, eq. 1.
    """
    x, dt = np.asarray(x, dtype=float), np.asarray(dt, dtype=float)
    density = np.stack(np.broadcast_arrays(np.asarray(sigma_a) ** 2.0, np.asarray(sigma_steer) ** 2.0), axis=-1)
    dt = np.broadcast_to(dt, np.broadcast_shapes(x.shape[:-1], dt.shape))
    struck = dt * ((1 + NODES) / 2).reshape(3, *[1] * dt.ndim)  # when the noise strikes, points first: (3, ...)
    to_end = bicycle(bicycle(x, struck, wheelbase)[0], dt - struck, wheelbase)[1][..., [2, 4]]
    rates = (to_end * density[..., None, :]) @ transpose(to_end)
    return symmetrise(np.tensordot(WEIGHTS / 2, rates, axes=1) * dt[..., None, None])


def bicycle_velocity(x: Array) -> tuple[Array, Array]:
    """Velocity of the car's centre (..., 2) m/s for states (..., 5), and its Jacobian (..., 2, 5). Lou 2002, eq. 1.

    Its length is |v| sqrt(1 + 3 cos^2 phi) / (2 cos phi), its direction theta + atan(tan(phi) / 2).
    """
    v, theta, phi = x[..., 2, None], x[..., 3], np.clip(x[..., 4, None], -STEERING_LIMIT, STEERING_LIMIT)
    along, across = _axes(theta)
    half = np.tan(phi) / 2
    J = np.zeros((*x.shape[:-1], 2, 5))
    J[..., 2] = along + half * across
    J[..., 3] = v * (across - half * along)
    J[..., 4] = v * across * (1 + 4 * half**2) / 2
    return v * J[..., 2], J


def _axes(heading: Array) -> tuple[Array, Array]:
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)


def _sinc(x: Array) -> tuple[Array, Array]:
    """sin(x)/x and its derivative, by series where the quotients would cancel."""
    small = np.abs(x) < 1e-2
    safe = np.where(small, 1.0, x)
    value = np.where(small, 1 - x**2 / 6 + x**4 / 120, np.sin(safe) / safe)
    slope = np.where(small, -x / 3 + x**3 / 30 - x**5 / 840, (safe * np.cos(safe) - np.sin(safe)) / safe**2)
    return value, slope
