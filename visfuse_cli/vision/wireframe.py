"""A vehicle as a box on the ground plane, fitted to the outline of its region (Lou 2002, sec. 2, pose refinement).

Outline and projected wireframe are compared by their tangents: in each of a fan of image directions, the
distance from the region's outermost point to the wireframe's tangent line there. All boxes are fitted at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from visfuse_cli.maths.cameras import project
from visfuse_cli.records import Array, GroundCamera

DIRECTIONS = 24
FAN = np.column_stack([np.cos(a := np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS), np.sin(a)])  # (K, 2)
AXES = np.arange(DIRECTIONS) % (DIRECTIONS // 4) == 0  # the four sides of an upright box
_SIGNS = np.array([[i, j, k] for k in (0, 1) for i in (-1, 1) for j in (-1, 1)], dtype=float)
EDGES = ((0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7))


@dataclass(frozen=True, slots=True)
class Outlines:
    """Tangents of N regions: support (N, K) px along FAN, `valid` where the region's own border is seen."""

    support: Array
    valid: np.ndarray


@dataclass(frozen=True, slots=True)
class BoxFit:
    """Fitted boxes: pose (N, 3) x, y m and theta rad; size (N, 3) l, w, h m; cov (N, 6, 6); rms (N,) px; ok (N,)."""

    pose: Array
    size: Array
    cov: Array
    rms: Array
    ok: np.ndarray


def corners(pose: Array, size: Array) -> Array:
    """The eight corners (..., 8, 3) m of boxes with pose (..., 3) and size (..., 3); bottom four first."""
    half = _SIGNS * [0.5, 0.5, 1.0]
    local = half * size[..., None, :]
    c, s = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    x = pose[..., 0, None] + c * local[..., 0] - s * local[..., 1]
    y = pose[..., 1, None] + s * local[..., 0] + c * local[..., 1]
    return np.stack([x, y, local[..., 2]], axis=-1)


def _corner_jacobian(pose: Array, size: Array) -> Array:
    """d corner / d (x, y, theta, l, w, h): (N, 8, 3, 6)."""
    half = _SIGNS * [0.5, 0.5, 1.0]
    local = half * size[:, None, :]
    c, s = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    J = np.zeros((len(pose), 8, 3, 6))
    J[..., 0, 0] = J[..., 1, 1] = 1
    J[..., 0, 2] = -s * local[..., 0] - c * local[..., 1]
    J[..., 1, 2] = c * local[..., 0] - s * local[..., 1]
    J[..., 0, 3], J[..., 1, 3] = c * half[:, 0], s * half[:, 0]
    J[..., 0, 4], J[..., 1, 4] = -s * half[:, 1], c * half[:, 1]
    J[..., 2, 5] = half[:, 2]
    return J


def outline(hull: Array, at_border: np.ndarray, upright: bool = False) -> tuple[Array, np.ndarray]:
    """Support (K,) of a hull (k, 2) px in the fan's directions, and where it counts.

    Directions whose tangent touches the hull `at_border` (k,) see the frame's edge and not the vehicle; of an upright
    detection box only its four sides count.
    """
    reach = hull @ FAN.T
    outermost = np.argmax(reach, axis=0)
    valid = ~at_border[outermost]
    if upright:
        valid &= AXES
    return reach[outermost, np.arange(DIRECTIONS)], valid


def fit(
    camera: GroundCamera,
    outlines: Outlines,
    pose: Array,
    pose_sigma: Array,
    size: Array,
    size_sigma: Array,
    sigma_px: Array,
    iterations: int = 6,
) -> BoxFit:
    """Fit N boxes to N outlines by Gauss-Newton from `pose` (N, 3) and `size` (N, 3).

    pose_sigma, size_sigma (N, 3) are the priors' deviations (inf: none); the prior on x, y is normally none, that on
    theta the predicted heading's; sigma_px (N,) is the noise of each outline's tangents. Lou 2002, sec. 2 and 4.1.
    """
    prior = np.concatenate([pose, size], axis=1)
    weight = 1 / np.concatenate([pose_sigma, size_sigma], axis=1) ** 2
    x = prior.copy()
    valid = outlines.valid
    noise = np.asarray(sigma_px, dtype=float)[:, None]
    rows = np.arange(len(x))[:, None]
    N = np.tile(np.eye(6), (len(x), 1, 1))
    residual = np.zeros_like(outlines.support)
    for _ in range(iterations):
        pixels, J_pixel = project(camera, corners(x[:, :3], x[:, 3:]))
        reach = np.einsum("nck,dk->ncd", pixels, FAN)  # (N, 8, K)
        active = np.argmax(np.nan_to_num(reach, nan=-np.inf), axis=1)  # (N, K)
        J_corner = J_pixel @ _corner_jacobian(x[:, :3], x[:, 3:])  # (N, 8, 2, 6)
        J = np.nan_to_num(np.einsum("ndkp,dk->ndp", J_corner[rows, active], FAN))
        residual = np.nan_to_num(outlines.support - np.take_along_axis(reach, active[:, None], axis=1)[:, 0])
        # A Cauchy weight: a mirror, a patch of shadow or a missing corner moves one tangent, not the box.
        robust = valid / (1 + (residual / (3 * noise)) ** 2) / noise**2
        N = np.einsum("nd,ndp,ndq->npq", robust, J, J) + weight[:, :, None] * np.eye(6)
        N += 1e-9 * np.trace(N, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        gradient = np.einsum("nd,ndp,nd->np", robust, J, residual) + weight * (prior - x)
        step = np.linalg.solve(N, gradient[..., None])[..., 0]
        limit = np.minimum(1, 2.0 / np.maximum(np.linalg.norm(step[:, :2], axis=1), 1e-9))
        x = x + step * limit[:, None]
        x[:, 3:] = np.maximum(x[:, 3:], 0.2)
    seen = valid.sum(axis=1)
    rms = np.sqrt(np.sum(np.where(valid, residual**2, 0), axis=1) / np.maximum(seen, 1))
    ok = (seen >= 3) & np.all(np.isfinite(x), axis=1)
    return BoxFit(x[:, :3], x[:, 3:], np.asarray(np.linalg.inv(N)), rms, ok)


def silhouette(camera: GroundCamera, pose: Array, size: Array) -> Array:
    """Outline (k, 2) px of one box: the hull of its projected corners, empty when it is behind the camera."""
    pixels, _ = project(camera, corners(pose, size))
    if not np.isfinite(pixels).all():
        return np.zeros((0, 2))
    return np.asarray(cv2.convexHull(pixels.astype(np.float32)), dtype=float).reshape(-1, 2)
