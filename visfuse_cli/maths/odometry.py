"""Where a camera on wheels is: wheel speeds to poses, poses in between, their covariance (Jia 2008, sec. 3).

World: x right, y down, z forward; theta is the yaw to the left. The optical axis is (-sin theta, 0, cos theta).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from visfuse_cli.records import Array


@dataclass(frozen=True, slots=True)
class Poses:
    """A camera over time: t (n,) s, R (n, 3, 3) world_from_camera, T (n, 3) m, cov (n, 4, 4) of T and theta."""

    t: Array
    R: Array
    T: Array
    theta: Array
    cov: Array


def rotation(theta: Array, pitch: Array | float = 0.0) -> Array:
    """world_from_camera (..., 3, 3) of yaw and pitch (...) rad, pitch positive up. Jia 2008, eq. 10."""
    theta, pitch = np.broadcast_arrays(np.asarray(theta, dtype=float), np.asarray(pitch, dtype=float))
    c, s, cp, sp = np.cos(theta), np.sin(theta), np.cos(pitch), np.sin(pitch)
    zero = np.zeros_like(c)
    right = np.stack([c, zero, s], axis=-1)
    axis = np.stack([-s * cp, -sp, c * cp], axis=-1)
    return np.stack([right, np.cross(axis, right), axis], axis=-1)


def driven(t: Array, left: Array, right: Array, separation: float, at: Array) -> tuple[Array, Array]:
    """Heading psi (m,) rad and axle position (m, 3) m at times `at` (m,), from wheel speeds (n,) m/s at t (n,) s.

    Speeds are linear between samples; each stretch between two instants is an exact arc at its mean speeds. Beyond the
    samples the nearest speeds hold. The path begins at the first instant of `t`. Jia 2008, eqs. 9-11.
    """
    knots = np.unique(np.concatenate([t, at]))
    v1, v2 = np.interp(knots, t, left), np.interp(knots, t, right)
    dt = np.diff(knots)
    speed = (v1[1:] + v1[:-1] + v2[1:] + v2[:-1]) / 4
    rate = ((v2[1:] + v2[:-1]) - (v1[1:] + v1[:-1])) / (2 * separation)  # dtheta/dt = (v2 - v1) / b
    heading = np.concatenate([[0.0], np.cumsum(rate * dt)])
    turn = rate * dt
    chord = speed * dt * np.sinc(turn / (2 * np.pi))
    course = heading[:-1] + turn / 2
    step = chord[:, None] * np.stack([-np.sin(course), np.zeros_like(course), np.cos(course)], axis=1)
    place = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
    start = int(np.searchsorted(knots, t[0]))
    turned, place = heading - heading[start], (place - place[start]) @ rotation(heading[start])
    index = np.searchsorted(knots, at)
    return turned[index], place[index]


def from_wheels(
    t: Array,
    left: Array,
    right: Array,
    separation: float,
    yaw: float,
    offset: Array,
    at: Array,
    noise: tuple[float, float],
) -> Poses:
    """Poses of a camera mounted at `offset` (3,) [right, down, forward] m from the axle's middle, turned by `yaw` rad.

    noise: deviation of a wheel's speed as a share of it, and in m/s; it makes a random walk of the pose.
    """
    heading, axle = driven(t, left, right, separation, at)
    vehicle = rotation(heading)
    R = rotation(heading + yaw)
    T = axle + vehicle @ offset
    speed = np.abs(np.interp(at, t, (left + right) / 2))
    dt = np.diff(at, prepend=at[0])
    sigma = noise[0] * speed + noise[1]
    along = np.cumsum(sigma**2 * np.abs(dt) * 0.05)
    turned = np.cumsum(2 * (sigma / separation) ** 2 * np.abs(dt) * 0.05)
    cov = np.zeros((len(at), 4, 4))
    cov[:, range(3), range(3)] = along[:, None] + turned[:, None] * (np.linalg.norm(T - T[0], axis=1)[:, None]) ** 2 / 3
    cov[:, 3, 3] = turned
    return Poses(at, R, T, heading + yaw, cov)


def from_track(t: Array, x: Array, y: Array, z: Array, theta: Array, pitch: Array, at: Array) -> Poses:
    """Poses at times `at` (m,) of a track that says where the left camera was; linear in between."""
    heading = np.interp(at, t, np.unwrap(theta))
    T = np.stack([np.interp(at, t, values) for values in (x, y, z)], axis=1)
    return Poses(at, rotation(heading, np.interp(at, t, pitch)), T, heading, np.zeros((len(at), 4, 4)))


def relative(poses: Poses, origin: Poses) -> Poses:
    """The same poses in the camera's frame at the first pose of `origin`."""
    R0, T0 = origin.R[0], origin.T[0]
    return Poses(poses.t, R0.T @ poses.R, (poses.T - T0) @ R0, poses.theta - origin.theta[0], poses.cov)
