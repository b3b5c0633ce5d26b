"""Plane-to-plane projective maps and their derivatives (Bradshaw 1997, sec. 3)."""

from __future__ import annotations

import numpy as np

from visfuse_cli.records import Array


def apply(H: Array, points: Array) -> Array:
    """Map points (N, 2) by H (3, 3): (N, 2)."""
    homogeneous = points @ H[:, :2].T + H[:, 2]
    return homogeneous[:, :2] / homogeneous[:, 2:]


def depth(H: Array, points: Array) -> Array:
    """Third homogeneous coordinate (N,) of the mapped points (N, 2); its sign tells the side of the horizon."""
    return points @ H[2, :2] + H[2, 2]


def jacobian(H: Array, points: Array) -> Array:
    """d mapped / d point (N, 2, 2)."""
    mapped, w = apply(H, points), depth(H, points)
    return (H[:2, :2] - mapped[:, :, None] * H[2, :2]) / w[:, None, None]


def entry_jacobian(H: Array, points: Array) -> Array:
    """d mapped / d entries of H, row by row (N, 2, 9)."""
    mapped, w = apply(H, points), depth(H, points)
    source = np.column_stack([points, np.ones(len(points))]) / w[:, None]
    J = np.zeros((len(points), 2, 9))
    J[:, 0, 0:3] = J[:, 1, 3:6] = source
    J[:, :, 6:9] = -mapped[:, :, None] * source[:, None, :]
    return J


def normalised(H: Array) -> Array:
    """H scaled to H[2][2] = 1, or to unit Frobenius norm where the image's corner lies on the horizon."""
    norm = np.linalg.norm(H)
    return H / H[2, 2] if abs(H[2, 2]) > 1e-6 * norm else H / norm
