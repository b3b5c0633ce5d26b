"""Motions by speed and course on the ground: constant speed and direction, constant speed, constant direction.

All share the state [X, Y, s, theta, s', theta'] (m, m/s, rad, and their rates). What a motion holds constant has no
rate: the rate is zero there, with the variance that the motion grants it. Bradshaw 1997, sec. 4.1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from visfuse_cli.maths.angles import wrap
from visfuse_cli.maths.gaussian import symmetrise, transpose
from visfuse_cli.maths.motion import NODES, WEIGHTS, axes, sinc
from visfuse_cli.records import Array

ANGLES = (3,)  # components of the state that are angles
CSD, CS, CD = (False, False), (False, True), (True, False)  # speeds up? turns?


def advance(x: Array, dt: ArrayLike, kind: tuple[bool, bool]) -> tuple[Array, Array]:
    """States (..., 6) after dt (...) s and the Jacobian (..., 6, 6); kind is CSD, CS or CD. Bradshaw 1997, sec. 4.1.

    Exact along the motion: the way times the chord of the arc, in the direction half-way; by series where the rate of
    turn is nearly zero.
    """
    speeds_up, turns = kind
    s, theta, ds, dtheta = (x[..., k] for k in range(2, 6))
    dt, zero = np.asarray(dt, dtype=float), np.zeros_like(s)
    rate, pull = (dtheta if turns else zero), (ds if speeds_up else zero)
    way, turn = s * dt + pull * dt**2 / 2, rate * dt
    chord, chord_slope = sinc(turn / 2)
    along, across = axes(theta + turn / 2)
    by_way = chord[..., None] * along

    F = np.zeros((*way.shape, 6, 6))
    F[..., range(4), range(4)] = 1
    F[..., :2, 2] = dt[..., None] * by_way
    F[..., :2, 3] = (way * chord)[..., None] * across
    if speeds_up:
        F[..., :2, 4] = (dt**2 / 2)[..., None] * by_way
        F[..., 2, 4], F[..., 4, 4] = dt, 1
    if turns:
        bend = chord_slope[..., None] * along + chord[..., None] * across
        F[..., :2, 5] = (way * dt / 2)[..., None] * bend
        F[..., 3, 5], F[..., 5, 5] = dt, 1
    moved = np.empty(F.shape[:-1])
    moved[..., :2] = x[..., :2] + way[..., None] * by_way
    moved[..., 2], moved[..., 3] = s + pull * dt, wrap(theta + turn)
    moved[..., 4], moved[..., 5] = pull, rate
    return moved, F


def noise(
    x: Array, dt: ArrayLike, kind: tuple[bool, bool], speed: float, turn: float, spare: tuple[float, float]
) -> Array:
    """Q (..., 6, 6) over dt (...) s, white noise on the highest rates of speed and course. Bradshaw 1997, sec. 4.1.

    speed and turn are densities: of s' (m^2 s^-3) where the speed is constant, else of s'' (m^2 s^-5); of theta'
    (rad^2/s) where the direction is constant, else of theta'' (rad^2 s^-3). spare: variances of the rates s' (m/s^2)^2
    and theta' (rad/s)^2 where the motion has none. A value e held over each step T, as in the paper, has density e^2 T.
    """
    speeds_up, turns = kind
    dt = np.broadcast_to(np.asarray(dt, dtype=float), x.shape[:-1])
    struck = dt * ((1 + NODES) / 2).reshape(3, *[1] * dt.ndim)  # when the noise strikes, points first: (3, ...)
    driven = [4 if speeds_up else 2, 5 if turns else 3]
    to_end = advance(advance(x, struck, kind)[0], dt - struck, kind)[1][..., driven]
    rates = (to_end * np.array([speed, turn])) @ transpose(to_end)
    Q = symmetrise(np.tensordot(WEIGHTS / 2, rates, axes=1) * dt[..., None, None])
    if not speeds_up:
        Q[..., 4, 4] = spare[0]
    if not turns:
        Q[..., 5, 5] = spare[1]
    return Q


def velocity(x: Array) -> tuple[Array, Array]:
    """Velocity (..., 2) m/s of states (..., 6) and its Jacobian (..., 2, 6)."""
    s, (along, across) = x[..., 2], axes(x[..., 3])
    J = np.zeros((*x.shape[:-1], 2, 6))
    J[..., 2], J[..., 3] = along, s[..., None] * across
    return s[..., None] * along, J


def observe(x: Array) -> tuple[Array, Array]:
    """What is measured, [X, Y, X', Y'] (..., 4), and its Jacobian (..., 4, 6). Bradshaw 1997, sec. 4.1.1."""
    V, J = velocity(x)
    position = np.broadcast_to(np.eye(2, 6), J.shape)
    return np.concatenate([x[..., :2], V], axis=-1), np.concatenate([position, J], axis=-2)
