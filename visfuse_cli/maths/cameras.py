"""The camera behind a ground-plane homography: what a height above the plane looks like in the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.errors import InputError
from visfuse_cli.records import Array, GroundCamera, GroundMap

# Lenses of fixed cameras lie between 0.5 and 6 image widths; the prior only decides where the plane does not
# (a camera that looks straight down sees the same homography with every focal length).
FOCAL_PRIOR_WIDTHS = 1.2
FOCAL_PRIOR_LOG_SIGMA = 0.6


def ground_camera(ground: GroundMap, image_size: tuple[int, int]) -> GroundCamera:
    """Recover the projection of heights from a ground homography, with the lens file's K or an estimated focal.

    image_size (w, h) px. Without a lens the principal point is the image centre and pixels are square; the focal
    length follows from the orthogonality of the plane's axes. Raises InputError when no camera fits the homography.
    Bradshaw 1997, sec. 3.
    """
    image_from_ground = ground.ground_sign * np.linalg.inv(ground.ground_from_image)
    if ground.lens is not None:
        K = ground.lens.K
    else:
        focal = _focal_length(ground, image_size)
        K = np.array([[focal, 0, image_size[0] / 2 - 0.5], [0, focal, image_size[1] / 2 - 0.5], [0, 0, 1.0]])
    frontal = np.linalg.solve(K, image_from_ground)
    scale = np.sqrt(np.linalg.norm(frontal[:, 0]) * np.linalg.norm(frontal[:, 1]))
    frontal, image_from_ground = frontal / scale, image_from_ground / scale
    normal = np.cross(frontal[:, 0], frontal[:, 1])
    normal /= np.linalg.norm(normal)
    # The world may be left-handed (a map with y down): up is the side of the plane that the camera is on.
    centre = _centre(frontal, normal)
    if centre[2] < 0:
        normal, centre = -normal, centre * [1, 1, -1]
    if not np.all(np.isfinite(centre)) or centre[2] < 1e-6:
        raise InputError("homography: no camera above the ground plane sees it this way; check points and their order")
    P = np.column_stack([image_from_ground[:, 0], image_from_ground[:, 1], K @ normal, image_from_ground[:, 2]])
    return GroundCamera(P, ground, centre, float(np.sqrt(K[0, 0] * K[1, 1])), image_size)


def _centre(frontal: Array, normal: Array) -> Array:
    return np.asarray(-np.linalg.solve(np.column_stack([frontal[:, 0], frontal[:, 1], normal]), frontal[:, 2]))


def _focal_length(ground: GroundMap, image_size: tuple[int, int]) -> float:
    """Most probable focal length (px) under the homography's covariance and a broad prior."""
    width = max(image_size)
    log_f = np.log(width) + np.linspace(np.log(0.25), np.log(12), 400)
    offset = np.array([[1, 0, 0.5 - image_size[0] / 2], [0, 1, 0.5 - image_size[1] / 2], [0, 0, 1.0]])

    def violation(ground_from_image: Array) -> Array:
        """How far the plane's axes are from orthonormal at each focal length: (400, 2), dimensionless."""
        g = offset @ np.linalg.inv(ground_from_image)
        f = np.exp(log_f)[:, None]
        b1 = np.column_stack([g[0, 0] / f, g[1, 0] / f, np.full(f.shape, g[2, 0])])
        b2 = np.column_stack([g[0, 1] / f, g[1, 1] / f, np.full(f.shape, g[2, 1])])
        n1, n2 = np.linalg.norm(b1, axis=1), np.linalg.norm(b2, axis=1)
        return np.column_stack([np.sum(b1 * b2, axis=1) / (n1 * n2), np.log(n1 / n2)])

    H = ground.ground_from_image
    values, vectors = np.linalg.eigh(ground.cov)
    steps = (vectors * np.sqrt(np.clip(values, 0, None))).T.reshape(-1, 3, 3)
    c = violation(H)
    spread = np.stack([(violation(H + step) - violation(H - step)) / 2 for step in steps])
    S = np.einsum("sfi,sfj->fij", spread, spread) + 1e-6 * np.eye(2)  # floor: pixels are square to a thousandth
    cost = np.einsum("fi,fi->f", c, np.linalg.solve(S, c[..., None])[..., 0]) + np.linalg.slogdet(S)[1]
    cost += ((log_f - np.log(FOCAL_PRIOR_WIDTHS * width)) / FOCAL_PRIOR_LOG_SIGMA) ** 2
    return float(np.exp(log_f[np.argmin(cost)]))


def raised(camera: GroundCamera, height: float) -> GroundCamera:
    """The same camera over the plane `height` m above the surveyed one, with X and Y as they are.

    Ground points move towards the camera's foot by height * cot(alpha). Raises ValueError where the camera is not
    above that plane. Bradshaw 1997, sec. 3.
    """
    if height >= camera.centre[2]:
        raise ValueError(f"the camera is {camera.centre[2]:.1f} m above the ground, and so not above {height:g} m")
    share = 1 - height / camera.centre[2]
    shift = np.array([[share, 0, 0], [0, share, 0], [0, 0, 1.0]])
    shift[:2, 2] = (1 - share) * camera.centre[:2]
    P = camera.image_from_world.copy()
    P[:, 3] += height * P[:, 2]
    entries = np.kron(shift, np.eye(3))  # of d (shift @ H) / d H, row by row
    ground = camera.ground
    plane = replace(ground, ground_from_image=shift @ ground.ground_from_image, cov=entries @ ground.cov @ entries.T)
    return replace(camera, image_from_world=P, ground=plane, centre=camera.centre - [0, 0, height])


def project(camera: GroundCamera, points: Array) -> tuple[Array, Array]:
    """Project world points (..., 3) m to undistorted pixels (..., 2) with the Jacobian (..., 2, 3) px/m.

    Points at or behind the camera come out as NaN.
    """
    P = camera.image_from_world
    homogeneous = points @ P[:, :3].T + P[:, 3]
    depth = homogeneous[..., 2:]
    depth = np.where(depth > 1e-9, depth, np.nan)
    pixels = homogeneous[..., :2] / depth
    jacobian = (P[:2, :3] - pixels[..., None] * P[2, :3]) / depth[..., None]
    return pixels, jacobian


def below_horizon(camera: GroundCamera, points: Array) -> NDArray[np.bool_]:
    """Which image points (..., 2) show the ground."""
    H = camera.ground.ground_from_image
    return np.asarray((points @ H[2, :2] + H[2, 2]) * camera.ground.ground_sign > 0)


def ground_scale(camera: GroundCamera, points: Array) -> Array:
    """Metres of ground (...) under a pixel in the worst direction at image points (..., 2); inf above the horizon."""
    H = camera.ground.ground_from_image
    homogeneous = points @ H[:, :2].T + H[:, 2]
    below = homogeneous[..., 2] * camera.ground.ground_sign > 0  # the horizon
    w = np.where(below, homogeneous[..., 2], 1.0)[..., None]
    ground = homogeneous[..., :2] / w
    J = (H[:2, :2] - ground[..., None] * H[2, :2]) / w[..., None]
    frobenius = np.sum(J * J, axis=(-2, -1))
    determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
    largest = np.sqrt((frobenius + np.sqrt(np.maximum(frobenius**2 - 4 * determinant**2, 0))) / 2)
    return np.where(below, largest, np.inf)


def elevation(camera: GroundCamera, ground_points: Array, height: float) -> Array:
    """Ground point under a tracked point at `height` m whose ray meets the plane at ground_points (..., 2).

    It moves towards the camera's foot by height * cot(alpha), alpha the ray's angle to the plane.
    """
    foot, above = camera.centre[:2], camera.centre[2]
    return foot + (ground_points - foot) * (1 - height / above)
