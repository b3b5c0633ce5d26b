"""Planes n.P = d that move with a rigid body, and the homographies they induce (Zhu 2012, sec. III).

x2 = R x1 + t; a rigid motion P' = R P + t takes a plane to n' = R n, d' = d + n'.t, and induces on pixels
H = K (R + t n^T / d) K^-1. All batched over leading axes.
"""

from __future__ import annotations

import numpy as np

from visfuse_cli.maths.gaussian import times, transpose
from visfuse_cli.records import Array, StereoRig


def moved_plane(n: Array, d: Array, R: Array, t: Array) -> tuple[Array, Array]:
    """The plane (n (..., 3), d (...) m) after a rigid motion R (..., 3, 3), t (..., 3). Zhu 2012, eq. 11."""
    turned = times(R, n)
    return turned, d + np.sum(turned * t, axis=-1)


def induced(K2: Array, K1: Array, R: Array, t: Array, n: Array, d: Array) -> Array:
    """H (..., 3, 3) from pixels before a motion (or of camera 1) to those after (of camera 2). Zhu 2012, eq. 5."""
    outer = t[..., :, None] * n[..., None, :] / np.asarray(d)[..., None, None]
    return np.asarray(K2 @ (R + outer) @ np.linalg.inv(K1), dtype=float)


def right_motion(rig: StereoRig, R: Array, t: Array) -> tuple[Array, Array]:
    """A motion R (..., 3, 3), t (..., 3) of the left camera's frame as the right camera sees it. Zhu 2012, eq. 10."""
    R_right = rig.R @ R @ rig.R.T
    return R_right, times(np.broadcast_to(rig.R, R_right.shape), t) + rig.T - times(R_right, rig.T)


def right_plane(rig: StereoRig, n: Array, d: Array) -> tuple[Array, Array]:
    """The plane in the right camera's frame. Zhu 2012, eq. 10."""
    turned = n @ rig.R.T
    return turned, d + turned @ rig.T


def across(rig: StereoRig, n: Array, d: Array) -> Array:
    """H (..., 3, 3) from left to right pixels of points on the plane (n, d). Zhu 2012, eq. 15."""
    return induced(rig.right.K, rig.left.K, rig.R, rig.T, n, d)


def shifted(K: Array, k: Array, v: Array, n: Array, d: Array) -> Array:
    """H (..., 3, 3) of a plane carried by v (...) m along k (3,). Zhu 2012, eqs. 22-24."""
    return induced(K, K, np.eye(3), np.asarray(v)[..., None] * k, n, d)


def on_plane(K: Array, pixels: Array, n: Array, d: Array) -> Array:
    """Points (..., 3) m where the rays of pixels (..., 2) meet the plane (n (3,), d)."""
    rays = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1) @ np.linalg.inv(K).T
    return np.asarray(rays * (d / (rays @ n))[..., None], dtype=float)


def projected(K: Array, points: Array) -> Array:
    """Pixels (..., 2) of points (..., 3) m; NaN where they are not before the camera."""
    depth = np.where(points[..., 2:] > 1e-3, points[..., 2:], np.nan)
    return np.asarray((points @ K.T)[..., :2] / depth, dtype=float)


def in_right(rig: StereoRig, points: Array) -> Array:
    """Points (..., 3) m of the left camera's frame in the right one's."""
    return np.asarray(points @ rig.R.T + rig.T)


def triangulated(rig: StereoRig, left: Array, right: Array) -> Array:
    """Points (..., 3) m seen at undistorted left and right pixels (..., 2): the middle of where the rays pass."""
    a = np.concatenate([left, np.ones_like(left[..., :1])], axis=-1) @ np.linalg.inv(rig.left.K).T
    b = np.concatenate([right, np.ones_like(right[..., :1])], axis=-1) @ np.linalg.inv(rig.right.K).T @ rig.R
    centre = -rig.R.T @ rig.T
    A = np.stack([a, -b], axis=-1)
    s = np.linalg.solve(transpose(A) @ A, transpose(A) @ np.broadcast_to(centre, a.shape)[..., None])[..., 0]
    return np.asarray((s[..., :1] * a + centre + s[..., 1:] * b) / 2, dtype=float)


def epipolar_offset(rig: StereoRig, left: Array, right: Array) -> Array:
    """How far (...) px right pixels (..., 2) lie off the epipolar lines of left ones, to below."""
    t = rig.T
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(rig.right.K).T @ cross @ rig.R @ np.linalg.inv(rig.left.K)
    line = np.concatenate([left, np.ones_like(left[..., :1])], axis=-1) @ F.T
    length = np.linalg.norm(line[..., :2], axis=-1) * np.where(line[..., 1] < 0, -1.0, 1.0)
    return np.asarray((np.sum(line[..., :2] * right, axis=-1) + line[..., 2]) / length, dtype=float)
