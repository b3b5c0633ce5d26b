"""The unconstrained rival: a plane that turns and moves freely in space, six degrees of freedom and their rates.

States (..., 13): middle (3) m, rotation vector (3), velocity (3) m/s, turn rate (3) rad/s, log size.
"""

from __future__ import annotations

import numpy as np

from visfuse_cli.records import Array

MIDDLE, TURN, VELOCITY, RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
SIZE, LENGTH = 12, 13
TURN_SHARE = 0.005  # rad a frame at 5 frames/s: change of the turn in a frame
KINEMATIC = [0, 1, 2, 6, 7, 8]


def rotations(vectors: Array) -> Array:
    """Rotations (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*np.shape(x), 3, 3)
    small = np.maximum(angle, 1e-9)
    return np.asarray(np.eye(3) + np.sin(small) / small * K + (1 - np.cos(small)) / small**2 * (K @ K))


def corners(shape: Array, states: Array) -> Array:
    """Corners (..., 4, 3) m of a plane whose corners lie at `shape` (4, 3) m from its middle before it turns."""
    scaled = np.exp(states[..., SIZE])[..., None, None] * shape
    return np.asarray(states[..., None, MIDDLE] + scaled @ np.swapaxes(rotations(states[..., TURN]), -1, -2))


def started(place: Array, spread: Array, velocity: Array) -> Array:
    """States (P, 13) at a place (3,) m, farther by shares `spread` (P,) along the line of sight, velocities (P, 3)."""
    states = np.zeros((len(spread), LENGTH))
    states[:, MIDDLE] = place * (1 + spread[:, None])
    states[:, VELOCITY] = velocity
    states[:, SIZE] = spread
    return states


def advanced(states: Array, dt: float, sigma_v: float, sigma_across: float, noise: Array) -> Array:
    """States (P, 13) after dt (s): constant rates, disturbed by noise (P, 6) of unit deviation. Zhu 2012, eqs. 9-11.

    sigma_v and sigma_across are m/s a frame at 5 frames/s, along the line of sight and across it.
    """
    root = float(np.sqrt(5 * dt))
    states = states.copy()
    states[:, MIDDLE] += states[:, VELOCITY] * dt
    states[:, TURN] += states[:, RATE] * dt
    states[:, VELOCITY] += root * np.array([sigma_across, sigma_across / 2, sigma_v]) * noise[:, :3]
    states[:, RATE] += 5 * TURN_SHARE * root * noise[:, 3:]
    return states
