"""Motion models: the step over dt with its Jacobian, and continuous noise, so that splitting a step changes nothing."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from visfuse_cli.maths.angles import wrap
from visfuse_cli.maths.gaussian import symmetrise, transpose
from visfuse_cli.records import Array, Gaussian

STEERING_LIMIT = 0.7  # rad; no road car's wheels turn further, and tan(phi) stays below 0.85
BICYCLE_MEASUREMENT = np.array([[1.0, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 0, 1, 0]])  # Lou 2002, eq. 2
# Three Gauss points integrate polynomials of degree 5; on a straight path the bicycle's noise needs degree 4.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(3)
STRIKES = np.append((1 + NODES) / 2, 1.0)  # the points as shares of a step, and the whole of it


def constant_velocity(dt: ArrayLike, dims: int = 2) -> Array:
    """F (..., 2 dims, 2 dims) over dt (...) s for the state [position (dims), velocity (dims)]. Jia 2008, eq. 19."""
    dt = np.asarray(dt, dtype=float)
    one = np.ones_like(dt)
    return _each_axis([[one, dt], [0 * dt, one]], dims)


def constant_velocity_noise(dt: ArrayLike, q: ArrayLike, dims: int = 2) -> Array:
    """Q (..., 2 dims, 2 dims) of white acceleration with density q (m^2 s^-3) over dt (...) s."""
    dt, q = np.broadcast_arrays(np.asarray(dt, dtype=float), np.asarray(q, dtype=float))
    return _each_axis([[q * dt**3 / 3, q * dt**2 / 2], [q * dt**2 / 2, q * dt]], dims)


def constant_acceleration(dt: ArrayLike, dims: int = 2) -> Array:
    """F (..., 3 dims, 3 dims) over dt (...) s for the state [position, velocity, acceleration]. Jia 2008, eq. 20.

    The position gains dt^2/2 times the acceleration, which the printed matrix leaves out.
    """
    dt = np.asarray(dt, dtype=float)
    one, zero = np.ones_like(dt), np.zeros_like(dt)
    return _each_axis([[one, dt, dt**2 / 2], [zero, one, dt], [zero, zero, one]], dims)


def constant_acceleration_noise(dt: ArrayLike, q: ArrayLike, dims: int = 2) -> Array:
    """Q (..., 3 dims, 3 dims) of white jerk with density q (m^2 s^-5) over dt (...) s."""
    dt, q = np.broadcast_arrays(np.asarray(dt, dtype=float), np.asarray(q, dtype=float))
    pp, pv, pa, va = dt**5 / 20, dt**4 / 8, dt**3 / 6, dt**2 / 2
    return _each_axis([[q * pp, q * pv, q * pa], [q * pv, q * dt**3 / 3, q * va], [q * pa, q * va, q * dt]], dims)


@lru_cache(maxsize=256)
def held_acceleration(dt: float, hold: float) -> tuple[Array, Array]:
    """F (3, 3), and Q (3, 3) at unit density, of one axis over dt s whose acceleration is forgotten within `hold` s.

    Singer's model: seen over longer than `hold` the acceleration is white, with the density that multiplies Q
    (m^2 s^-3). By Van Loan's matrix exponential, over steps that are short beside `hold`, doubled.
    """
    if dt > hold:
        half, own = held_acceleration(dt / 2, hold)
        return half @ half, np.asarray(symmetrise(half @ own @ half.T + own))
    rate = np.array([[0.0, 1, 0], [0, 0, 1], [0, 0, -1 / hold]])
    drive = np.diag([0.0, 0, 1 / hold**2])
    both = expm(np.block([[-rate, drive], [np.zeros((3, 3)), rate.T]]) * dt)
    F = both[3:, 3:].T
    return F, np.asarray(symmetrise(F @ both[:3, 3:]))


def drifting_point(dt: ArrayLike, dims: int = 2) -> Array:
    """F (..., 2 dims, 2 dims) over dt (...) s: the position stays, the velocity is forgotten. Jia 2008, eq. 18.

    The printed identity keeps a velocity that no longer moves the point: here it is zero, with `drifting_point_noise`.
    """
    zero = np.zeros_like(np.asarray(dt, dtype=float))
    return _each_axis([[zero + 1, zero], [zero, zero]], dims)


def drifting_point_noise(dt: ArrayLike, q: ArrayLike, velocity_variance: ArrayLike, dims: int = 2) -> Array:
    """Q (..., 2 dims, 2 dims) of a random walk with density q (m^2/s), its velocity unknown to (m/s)^2."""
    dt, q, vv = np.broadcast_arrays(*(np.asarray(value, dtype=float) for value in (dt, q, velocity_variance)))
    return _each_axis([[q * dt, 0 * q], [0 * q, vv]], dims)


def periodic(dt: ArrayLike, omega: ArrayLike, dims: int = 2, euler: bool = False) -> Array:
    """F (..., 3 dims, 3 dims) over dt (...) s for [position, velocity, centre], omega (...) rad/s. Jia 2008, eq. 21.

    The exact rotation about the centre; `euler` is the paper's forward step, whose swing grows by
    sqrt(1 + (omega dt)^2) each time.
    """
    dt, w = np.broadcast_arrays(np.asarray(dt, dtype=float), np.asarray(omega, dtype=float))
    zero = np.zeros_like(dt)
    if euler:
        c, s, r = zero + 1, dt, -(w**2) * dt
    else:
        c, s, r = np.cos(w * dt), dt * np.sinc(w * dt / np.pi), -w * np.sin(w * dt)
    return _each_axis([[c, s, 1 - c], [r, c, -r], [zero, zero, zero + 1]], dims)


def periodic_noise(dt: ArrayLike, omega: ArrayLike, q: ArrayLike, q_centre: ArrayLike, dims: int = 2) -> Array:
    """Q (..., 3 dims, 3 dims) of white acceleration (q, m^2 s^-3) and a wandering centre (q_centre, m^2/s)."""
    values = (dt, omega, q, q_centre)
    dt, w, q, qc = np.broadcast_arrays(*(np.asarray(value, dtype=float) for value in values))
    x = w * dt
    once, twice = np.sinc(x / np.pi), np.sinc(2 * x / np.pi)  # means of cos(w u) and cos(2 w u) over the step
    pp = q * dt**3 / 3 * _cubic(2 * x) + qc * dt * (1.5 - 2 * once + twice / 2)
    pv = q * dt**2 / 2 * once**2 + qc * (1 - np.cos(x)) ** 2 / 2
    vv = q * dt * (1 + twice) / 2 + qc * w**2 * dt * (1 - twice) / 2
    pc, vc, cc = qc * dt * (1 - once), qc * (1 - np.cos(x)), qc * dt
    return _each_axis([[pp, pv, pc], [pv, vv, vc], [pc, vc, cc]], dims)


def _cubic(x: Array) -> Array:
    """6 (x - sin x) / x^3, by series where it would cancel."""
    small = np.abs(x) < 0.1
    safe = np.where(small, 1.0, x)
    return np.where(small, 1 - x**2 / 20 + x**4 / 840, 6 * (safe - np.sin(safe)) / safe**3)


def _each_axis(block: list[list[Array]], dims: int) -> Array:
    """A block of order p, its entries (...), repeated for every axis: (..., p dims, p dims)."""
    matrix = np.stack([np.stack(row, axis=-1) for row in block], axis=-2)
    size = len(block) * dims
    return np.einsum("...ij,kl->...ikjl", matrix, np.eye(dims)).reshape(*matrix.shape[:-2], size, size)


def bicycle(x: Array, dt: ArrayLike, wheelbase: ArrayLike, straighten: float = 0.0) -> tuple[Array, Array]:
    """The car (..., 5) after dt (...) s with v and phi constant, and the Jacobian (..., 5, 5). Lou 2002, eq. 1.

    State [x, y, v, theta, phi]: the centre between the axles (m), the rear wheel's speed (m/s, negative in reverse),
    heading and steering angle (rad); wheelbase (...) m. phi is cut at STEERING_LIMIT, where the Jacobian is the inner
    side's, so that a filter at the limit can still turn back. Exact: the rear axle runs along a circle. Where drivers
    `straighten` up (1/s), phi goes back to zero at that rate and the circle is that of its mean over the step.
    """
    v, theta, phi = x[..., 2], x[..., 3], _within_limit(x[..., 4])
    dt, wheelbase = np.asarray(dt, dtype=float), np.asarray(wheelbase, dtype=float)
    decay = straighten * dt
    on_average = np.where(decay > 1e-6, -np.expm1(-decay) / np.maximum(decay, 1e-6), 1 - decay / 2)
    tau = np.tan(phi * on_average)
    way, turn = v * dt, v * dt * tau / wheelbase
    chord, chord_slope = sinc(turn / 2)
    # The rear axle's chord plus the turn of the half wheelbase ahead of it; both point along or across mid-heading.
    c, s = np.cos(theta + turn / 2), np.sin(theta + turn / 2)
    course_x, course_y = c - tau / 2 * s, s + tau / 2 * c
    arc, bent, straight = way * chord, chord_slope / 2, chord / 2
    by_turn_x, by_turn_y = way * (bent * course_x - straight * course_y), way * (bent * course_y + straight * course_x)

    tau_slope, by_speed, by_length = 1 + tau**2, dt * tau / wheelbase, way / wheelbase
    F = np.zeros((*turn.shape, 5, 5))
    for k in range(4):
        F[..., k, k] = 1
    F[..., 0, 2], F[..., 1, 2] = (
        dt * chord * course_x + by_turn_x * by_speed,
        dt * chord * course_y + by_turn_y * by_speed,
    )
    F[..., 0, 3], F[..., 1, 3] = -arc * course_y, arc * course_x
    F[..., 0, 4] = tau_slope * on_average * (-arc / 2 * s + by_turn_x * by_length)
    F[..., 1, 4] = tau_slope * on_average * (arc / 2 * c + by_turn_y * by_length)
    F[..., 3, 2], F[..., 3, 4] = by_speed, way * tau_slope * on_average / wheelbase
    F[..., 4, 4] = np.exp(-decay)
    x_next = np.empty(F.shape[:-1])
    x_next[..., 0], x_next[..., 1] = x[..., 0] + arc * course_x, x[..., 1] + arc * course_y
    x_next[..., 2], x_next[..., 3], x_next[..., 4] = v, wrap(theta + turn), phi * F[..., 4, 4]
    return x_next, F


def bicycle_noise(
    x: Array,
    dt: ArrayLike,
    wheelbase: ArrayLike,
    sigma_a: ArrayLike,
    sigma_steer: ArrayLike,
    straighten: float = 0.0,
) -> Array:
    """Q (..., 5, 5) over dt (...) s from white acceleration and white steering rate, carried through the motion.

    x (..., 5) is the state at the start; sigma_a (m/s^2 per root Hz) and sigma_steer (rad/s per root Hz) are the
    square roots of the spectral densities of a and b in Lou 2002, eq. 1; `straighten` as in `bicycle`.
    """
    return bicycle_step(x, dt, wheelbase, sigma_a, sigma_steer, straighten)[2]


def bicycle_step(
    x: Array,
    dt: ArrayLike,
    wheelbase: ArrayLike,
    sigma_a: ArrayLike,
    sigma_steer: ArrayLike,
    straighten: float = 0.0,
) -> tuple[Array, Array, Array]:
    """`bicycle`'s state and Jacobian, and `bicycle_noise`'s Q, from one evaluation.

    What strikes on the way is carried to the end as from the start, turned by the heading gained until then: exact
    where nothing is straightened.
    """
    x, dt = np.asarray(x, dtype=float), np.asarray(dt, dtype=float)
    by_speed, by_steering = np.asarray(sigma_a) ** 2.0, np.asarray(sigma_steer) ** 2.0
    density = np.empty((*np.broadcast_shapes(by_speed.shape, by_steering.shape), 2))
    density[..., 0], density[..., 1] = by_speed, by_steering
    dt = dt + np.zeros(x.shape[:-1])
    left = dt * STRIKES.reshape(4, *[1] * dt.ndim)  # when noise strikes, s before the end
    moved, F = bicycle(x, left, wheelbase, straighten)
    from_start, gained = F[:-1, ..., 2::2], wrap(moved[-2::-1, ..., 3] - x[..., 3])  # the nodes are symmetric
    c, s = np.cos(gained)[..., None], np.sin(gained)[..., None]
    along, across = from_start[..., 0, :], from_start[..., 1, :]
    to_end = from_start.copy()
    to_end[..., 0, :], to_end[..., 1, :] = c * along - s * across, s * along + c * across
    rates = (to_end * density[..., None, :]) @ transpose(to_end)
    mean_rate = (WEIGHTS / 2 @ rates.reshape(3, -1)).reshape(F.shape[1:])
    # copies: tracks keep these, and a view would keep the other points as well
    return moved[-1].copy(), F[-1].copy(), symmetrise(mean_rate * dt[..., None, None])


def _within_limit(phi: Array) -> Array:
    return np.asarray(np.minimum(np.maximum(phi, -STEERING_LIMIT), STEERING_LIMIT))


def bicycle_velocity(x: Array) -> tuple[Array, Array]:
    """Velocity of the car's centre (..., 2) m/s for states (..., 5), and its Jacobian (..., 2, 5). Lou 2002, eq. 1.

    Its length is |v| sqrt(1 + 3 cos^2 phi) / (2 cos phi), its direction theta + atan(tan(phi) / 2).
    """
    v, theta, phi = x[..., 2, None], x[..., 3], _within_limit(x[..., 4, None])
    along, across = axes(theta)
    half = np.tan(phi) / 2
    J = np.zeros((*x.shape[:-1], 2, 5))
    J[..., 2] = along + half * across
    J[..., 3] = v * (across - half * along)
    J[..., 4] = v * across * (1 + 4 * half**2) / 2
    return v * J[..., 2], J


def axes(heading: Array) -> tuple[Array, Array]:
    """Unit vectors (..., 2) along a heading (...) rad and to its left."""
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)


def sinc(x: Array) -> tuple[Array, Array]:
    """sin(x)/x and its derivative, by series where the quotients would cancel."""
    small, square = np.abs(x) < 1e-2, x * x
    value, slope = 1 - square * (1 / 6 - square / 120), -x * (1 / 3 - square * (1 / 30 - square / 840))
    if not small.all():
        safe = np.where(small, 1.0, x)
        value = np.where(small, value, np.sin(safe) / safe)
        slope = np.where(small, slope, (safe * np.cos(safe) - np.sin(safe)) / safe**2)
    return value, slope


def line_start(t: Array, places: Array, R: Array) -> tuple[Gaussian, Gaussian]:
    """Place (d,) at t = 0 and velocity (d,) of the line through places (n, d) at t (n,) s, n >= 2. Jia 2008, eq. 41.

    R (d, d) is the noise of one place, mapped through the measurement. Two places, the second at t = 0, give R and
    2 R / T^2. Raises LinAlgError where all t are the same.
    """
    A = np.column_stack([np.ones_like(t), t])
    share = np.linalg.inv(A.T @ A)
    place, velocity = share @ A.T @ places
    return Gaussian(place, share[0, 0] * R), Gaussian(velocity, share[1, 1] * R)
