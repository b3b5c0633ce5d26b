"""Plane-to-plane projective maps and their derivatives (Bradshaw 1997, sec. 3)."""

from __future__ import annotations

import numpy as np

from visfuse_cli.records import Array


def apply(H: Array, points: Array) -> Array:
    """Map points (N, 2) by H (3, 3): (N, 2)."""
    homogeneous = points @ H[:, :2].T + H[:, 2]
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


def invert(H: Array) -> Array:
    """The inverse map (3, 3) up to scale and sign: the adjugate, which exists for every H."""
    (a, b, c), (d, e, f), (g, h, i) = H.tolist()  # plain numbers: this runs in the innermost loop of every fit
    return np.array(
        [
            [e * i - f * h, c * h - b * i, b * f - c * e],
            [f * g - d * i, a * i - c * g, c * d - a * f],
            [d * h - e * g, b * g - a * h, a * e - b * d],
        ]
    )


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


def on_horizon(H: Array, points: Array) -> bool:
    """Whether the image's corner lies on the horizon, so that H cannot be scaled to H[2][2] = 1.

    `points` (N, 2) lie on the visible ground: what is nearly 0 is judged by the third coordinate there, so that far
    away world origins (UTM) change nothing.
    """
    return bool(abs(H[2, 2]) <= 1e-6 * np.abs(depth(H, points)).max())
