"""Maybank's covariance-updating filter: a car whose steering angle and acceleration wander as Brownian motions.

Lou 2002, sec. 1, describes it: the mean and the covariance themselves are propagated, to third order in the time step,
so the mean also moves by what the doubt does to a curved motion. Derived here from that description; the measurement is
taken in as by any Kalman filter (`gaussian.update`), or after fading the past (`fading.update`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from visfuse_cli.maths.angles import wrap
from visfuse_cli.maths.gaussian import symmetrise, times, transpose
from visfuse_cli.maths.motion import NODES, STEERING_LIMIT, WEIGHTS, axes, bicycle
from visfuse_cli.records import Array

DRIVEN = [4, 5]  # steering angle and acceleration


def steered(x: Array, dt: ArrayLike, wheelbase: ArrayLike, straighten: float = 0.0) -> tuple[Array, Array]:
    """The car (..., 6) after dt (...) s, acceleration and steering constant, and the Jacobian (..., 6, 6).

    State [x, y, v, theta, phi, a]: the bicycle's (Lou 2002, eq. 1) and the acceleration (m/s^2). Exact: the way along
    the arc is that of the mean speed. `straighten` (1/s) as in the bicycle.
    """
    dt = np.asarray(dt, dtype=float)
    shape = np.broadcast_shapes(x.shape[:-1], dt.shape)
    dt, x = np.broadcast_to(dt, shape), np.broadcast_to(x, (*shape, 6)).copy()
    gain = x[..., 5] * dt / 2
    x[..., 2] += gain  # the mean speed
    moved, by_state = bicycle(x[..., :5], dt, wheelbase, straighten)
    moved[..., 2] += gain
    F = np.zeros((*shape, 6, 6))
    F[..., :5, :5] = by_state
    F[..., :5, 5] = by_state[..., :, 2] * (dt / 2)[..., None]
    F[..., 2, 5] = dt
    F[..., 5, 5] = 1
    return np.concatenate([moved, x[..., 5:]], axis=-1), F


def noise(
    x: Array,
    dt: ArrayLike,
    wheelbase: ArrayLike,
    sigma_steer: ArrayLike,
    sigma_jerk: ArrayLike,
    straighten: float = 0.0,
) -> Array:
    """Q (..., 6, 6) over dt (...) s of Brownian steering (rad/s per root Hz) and acceleration (m/s^3 per root Hz)."""
    dt = np.broadcast_to(np.asarray(dt, dtype=float), x.shape[:-1])
    struck = dt * _fractions(dt)  # when the noise strikes, points first: (3, ...)
    there = steered(x, struck, wheelbase, straighten)[0]
    to_end = steered(there, dt - struck, wheelbase, straighten)[1][..., DRIVEN]
    density = np.stack(np.broadcast_arrays(np.asarray(sigma_steer) ** 2.0, np.asarray(sigma_jerk) ** 2.0), axis=-1)
    rates = (to_end * density[..., None, :]) @ transpose(to_end)
    return symmetrise(np.tensordot(WEIGHTS / 2, rates, axes=1) * dt[..., None, None])


def advance(
    x: Array,
    cov: Array,
    dt: ArrayLike,
    wheelbase: ArrayLike,
    sigma_steer: ArrayLike,
    sigma_jerk: ArrayLike,
    straighten: float = 0.0,
) -> tuple[Array, Array, Array]:
    """Mean (..., 6) dt (...) s later, the Jacobian F and the noise Q (..., 6, 6), so that P' = F P F^T + Q.

    The mean follows d E[x]/dt = f(E[x]) + f'':P / 2, with P as it grows along the way. Lou 2002, sec. 1.
    """
    dt = np.broadcast_to(np.asarray(dt, dtype=float), x.shape[:-1])
    mean, F = steered(x, dt, wheelbase, straighten)
    Q = noise(x, dt, wheelbase, sigma_steer, sigma_jerk, straighten)
    at = dt * _fractions(dt)
    there, to_there = steered(x, at, wheelbase, straighten)
    own = noise(np.broadcast_to(x, there.shape), at, wheelbase, sigma_steer, sigma_jerk, straighten)
    spread = to_there @ cov @ transpose(to_there) + own
    to_end = steered(there, dt - at, wheelbase, straighten)[1]
    drift = times(to_end, _curvature(there, spread, wheelbase))
    mean = mean + np.tensordot(WEIGHTS / 2, drift, axes=1) * dt[..., None]
    mean[..., 3] = wrap(mean[..., 3])
    return mean, F, Q


def _curvature(x: Array, P: Array, wheelbase: ArrayLike) -> Array:
    """f'':P / 2 (..., 6): how the mean of f(x) differs from f of the mean x (..., 6) with covariance P (..., 6, 6)."""
    v, theta, phi = x[..., 2], x[..., 3], np.clip(x[..., 4], -STEERING_LIMIT, STEERING_LIMIT)
    along, across = axes(theta)
    tau = np.tan(phi)
    slope, bend = 1 + tau**2, 2 * tau * (1 + tau**2)  # first and second derivative of tan(phi)
    half = (tau / 2)[..., None]
    course, turned = along + half * across, across - half * along  # direction of motion, and d/d theta of it
    P_vt, P_vf, P_tt, P_tf, P_ff = P[..., 2, 3], P[..., 2, 4], P[..., 3, 3], P[..., 3, 4], P[..., 4, 4]
    moved = (
        P_vt[..., None] * turned
        + (P_vf * slope / 2)[..., None] * across
        - (v * P_tt / 2)[..., None] * course
        - (v * P_tf * slope / 2)[..., None] * along
        + (v * P_ff * bend / 4)[..., None] * across
    )
    turn = (P_vf * slope + v * P_ff * bend / 2) / wheelbase
    rest = np.zeros_like(turn)
    return np.concatenate([moved, np.stack([rest, turn, rest, rest], axis=-1)], axis=-1)


def _fractions(dt: Array) -> Array:
    return ((1 + NODES) / 2).reshape(3, *[1] * dt.ndim)
