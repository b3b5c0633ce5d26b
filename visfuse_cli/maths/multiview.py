"""Several pinhole cameras over one ground plane: projections, rays, epipolar lines; batched over all leading axes.

Cameras are matrices P (3, 4) from metres to undistorted pixels. The ground is the plane z = 0 with z up, once the
world has been turned by `ground_from_world`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from visfuse_cli.maths.gaussian import symmetrise, times, transpose
from visfuse_cli.records import Array, Gaussian, View

NEAREST = 0.05  # m before a camera: what is nearer has no place in its picture


def projection(view: View) -> Array:
    """P (3, 4) of a camera without its distortion."""
    return np.asarray(view.lens.K @ np.column_stack([view.R, view.t]))


def ground_from_world(plane: Array) -> tuple[Array, Array]:
    """The rigid motion (R (3, 3), t (3,)) that takes the plane a x + b y + c z + d = 0 to z = 0, its normal up.

    A plane that is z = 0 already is left as it is. Raises ValueError where (a, b, c) is zero.
    """
    length = float(np.linalg.norm(plane[:3]))
    if not length > 0:
        raise ValueError("the normal of a plane cannot be zero")
    normal, d = plane[:3] / length, plane[3] / length
    # The world's axis that lies flattest stays as near to x as it can.
    flattest = np.eye(3)[int(np.argmin(np.abs(normal) + [0, 1e-6, 2e-6]))]
    x = flattest - (flattest @ normal) * normal
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal]), np.array([0.0, 0.0, d])


def moved_view(view: View, R: Array, t: Array) -> View:
    """The same camera in a world moved by x' = R x + t."""
    turned = view.R @ R.T
    return replace(view, R=turned, t=view.t - turned @ t)


def project(P: Array, points: Array) -> tuple[Array, Array]:
    """Pixels (..., 2) of points (..., 3) under cameras (..., 3, 4), with the Jacobian (..., 2, 3) px/m.

    Points that are not before the camera come out as NaN.
    """
    homogeneous = times(P[..., :3], points) + P[..., 3]
    depth = homogeneous[..., 2:]
    depth = np.where(depth > NEAREST, depth, np.nan)
    pixels = homogeneous[..., :2] / depth
    return pixels, (P[..., :2, :3] - pixels[..., None] * P[..., 2:, :3]) / depth[..., None]


def slopes(P: Array, points: Array) -> Array:
    """How steeply cameras P (C, 3, 4) look down at points (T, 3): tangents (T, C) of the angle under the horizon."""
    centres = -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[..., 0]
    apart = centres - points[:, None]
    return np.asarray(apart[..., 2] / np.maximum(np.linalg.norm(apart[..., :2], axis=-1), 1e-3))


def depths(P: Array, points: Array) -> Array:
    """Depths (...) m along the optical axes of points (..., 3) under cameras (..., 3, 4) with unit third rows."""
    return np.asarray(np.sum(P[..., 2, :3] * points, axis=-1) + P[..., 2, 3])


def on_plane(P: Array, pixels: Array, height: Array | float = 0.0) -> tuple[Array, Array]:
    """Where rays (..., 2) px meet the plane z = height (...): points (..., 2) m and the Jacobian (..., 2, 2) m/px.

    NaN where a ray does not meet it before the camera.
    """
    shifted = P[..., 2] * np.asarray(height)[..., None] + P[..., 3]
    image_from_plane = np.stack(np.broadcast_arrays(P[..., 0], P[..., 1], shifted), axis=-1)
    plane_from_image = np.asarray(np.linalg.inv(image_from_plane), dtype=float)
    homogeneous = times(plane_from_image[..., :2], pixels) + plane_from_image[..., 2]
    w = homogeneous[..., 2:]
    w = np.where(w > 0, w, np.nan)  # the camera's side of the horizon: P has positive depths
    points = homogeneous[..., :2] / w
    return points, (plane_from_image[..., :2, :2] - points[..., None] * plane_from_image[..., 2:, :2]) / w[..., None]


def ground_point(P: Array, pixels: Array, R: Array, height: Array | float, height_sigma: float) -> Gaussian:
    """Ground positions (..., 2) of points `height` (...) m up, seen at pixels (..., 2) with noise R (..., 2, 2).

    The doubt of the height moves a point along its ray's shadow on the ground.
    """
    points, J = on_plane(P, pixels, height)
    along = (on_plane(P, pixels, np.asarray(height) + 0.01)[0] - points) / 0.01
    cov = J @ R @ transpose(J) + height_sigma**2 * along[..., :, None] * along[..., None, :]
    return Gaussian(points, symmetrise(cov))


def fundamental(P1: Array, P2: Array) -> Array:
    """F (..., 3, 3) of pairs of cameras (..., 3, 4): x2^T F x1 = 0, both rows of the line in pixels."""
    M1, M2 = P1[..., :3], P2[..., :3]
    centre = -np.asarray(np.linalg.solve(M1, P1[..., 3:]), dtype=float)[..., 0]
    epipole = times(M2, centre) + P2[..., 3]
    zero = np.zeros_like(epipole[..., 0])
    a, b, c = np.moveaxis(epipole, -1, 0)
    cross: Array = np.stack([zero, -c, b, c, zero, -a, -b, a, zero], axis=-1).reshape(*zero.shape, 3, 3)
    return np.asarray(cross @ M2 @ np.linalg.inv(M1), dtype=float)


def epipolar_distance(F: Array, z1: Array, z2: Array) -> Array:
    """First-order distance (...) px of pairs of pixels (..., 2) from agreeing under F (..., 3, 3).

    The smallest joint shift of the two that puts them on each other's epipolar line, signed (Sampson).
    """
    x1, x2 = (np.concatenate([z, np.ones_like(z[..., :1])], axis=-1) for z in (z1, z2))
    line2, line1 = times(F, x1), times(transpose(F), x2)
    slope = np.sqrt(np.sum(line1[..., :2] ** 2, axis=-1) + np.sum(line2[..., :2] ** 2, axis=-1))
    return np.asarray(np.sum(x2 * line2, axis=-1) / np.maximum(slope, 1e-12))
