"""Where a camera on wheels is: wheel speeds to poses, poses in between, their covariance (Jia 2008, sec. 3).

World: x right, y down, z forward; theta is the yaw to the left. The optical axis is (-sin theta, 0, cos theta).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from visfuse_cli.records import Array

NOISE_S = 0.05  # s for which a wheel's error lasts


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


class Drive:
    """A drive told by wheel speeds left and right (n,) m/s at t (n,) s; `noise` is their deviation: a share, and m/s.

    The noise makes a random walk of the pose, with a memory of NOISE_S.
    """

    def __init__(self, t: Array, left: Array, right: Array, separation: float, noise: tuple[float, float]) -> None:
        self._samples = t, left, right
        self._separation = separation
        self._heading, self._axle = driven(t, left, right, separation, t)
        sigma2 = (noise[0] * np.abs(left + right) / 2 + noise[1]) ** 2 * np.diff(t, prepend=t[0]) * NOISE_S
        self._along, self._turned = np.cumsum(sigma2), np.cumsum(2 * sigma2) / separation**2

    def camera(self, at: Array, yaw: float, offset: Array) -> Poses:
        """Poses at times `at` (m,) of a camera turned by `yaw` rad to the left of the driving direction.

        It is mounted at `offset` (3,) [right, down, forward] m from the axle's middle.
        """
        heading, axle = (np.stack(part) for part in zip(*(self._axle_at(float(now)) for now in at), strict=True))
        T = axle + rotation(heading) @ offset
        along, turned = (np.interp(at, self._samples[0], walk) for walk in (self._along, self._turned))
        cov = np.zeros((len(at), 4, 4))
        away = np.linalg.norm(axle, axis=1) ** 2
        cov[:, range(3), range(3)] = (along + turned * away / 3)[:, None]
        cov[:, 3, 3] = turned
        return Poses(at, rotation(heading + yaw), T, heading + yaw, cov)

    def _axle_at(self, now: float) -> tuple[Array, Array]:
        """Heading and place (3,) of the axle: on from the sample before."""
        k = int(np.clip(np.searchsorted(self._samples[0], now, side="right") - 1, 0, len(self._heading) - 2))
        t, left, right = (column[k : k + 2] for column in self._samples)
        turned, moved = driven(t, left, right, self._separation, np.array([now]))
        return self._heading[k] + turned[0], self._axle[k] + rotation(self._heading[k]) @ moved[0]


def from_track(t: Array, x: Array, y: Array, z: Array, theta: Array, pitch: Array, at: Array) -> Poses:
    """Poses at times `at` (m,) of a track that says where the left camera was; linear in between."""
    heading = np.interp(at, t, np.unwrap(theta))
    T = np.stack([np.interp(at, t, values) for values in (x, y, z)], axis=1)
    return Poses(at, rotation(heading, np.interp(at, t, pitch)), T, heading, np.zeros((len(at), 4, 4)))


def relative(poses: Poses, origin: Poses) -> Poses:
    """The same poses in the camera's frame at the first pose of `origin`."""
    R0, T0 = origin.R[0], origin.T[0]
    return Poses(poses.t, R0.T @ poses.R, (poses.T - T0) @ R0, poses.theta - origin.theta[0], poses.cov)
