"""One point seen by several cameras: direct linear transform, Gauss-Newton, propagated covariance (Wu 2010, sec. 4)."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.gaussian import inverse, symmetrise, times, transpose
from visfuse_cli.maths.multiview import project
from visfuse_cli.records import Array, Gaussian

ROUNDS = 4
PARTNERS = 4  # of each camera, at most: the number of pairs then grows with the cameras and not with their square
FLATTEST = np.radians(4.0)  # rays that meet at less than this say next to nothing about depth


def linear(P: Array, z: Array) -> Array:
    """Points (..., 3) from pixels (..., V, 2) of V cameras (..., V, 3, 4), by the direct linear transform.

    A row that is not finite gives NaN.
    """
    rows = z[..., None] * P[..., 2:, :] - P[..., :2, :]
    rows = rows / np.linalg.norm(rows[..., :3], axis=-1, keepdims=True)
    A = rows.reshape(*rows.shape[:-3], 2 * rows.shape[-3], 4)
    good = np.isfinite(A).all(axis=(-2, -1))
    h = np.linalg.svd(np.where(good[..., None, None], A, 0.0), full_matrices=False)[2][..., -1, :]
    w = h[..., 3:]
    points = h[..., :3] / np.where(np.abs(w) > 1e-12, w, 1e-12)
    return np.where(good[..., None], points, np.nan)


def refine(P: Array, z: Array, R: Array, start: Array) -> tuple[Gaussian, Array]:
    """The most likely points (..., 3) by Gauss-Newton from `start`, and their reprojection chi-squares (..., V).

    z (..., V, 2) px with noise R (..., V, 2, 2) under P (..., V, 3, 4). Where the rays say nothing, or the point is
    not before every camera, the mean is NaN.
    """
    weight = inverse(R)
    point = start
    for _ in range(ROUNDS):
        pixels, J = project(P, point[..., None, :])
        J_W = transpose(J) @ weight
        information = np.sum(J_W @ J, axis=-3)
        step = np.sum(times(J_W, z - pixels), axis=-2)
        point = point + times(_inverse(information), step)
    pixels, J = project(P, point[..., None, :])
    off = z - pixels
    cov = _inverse(np.sum(transpose(J) @ weight @ J, axis=-3))
    chi2 = np.sum(off * times(weight, off), axis=-1)
    return Gaussian(point, symmetrise(cov)), chi2


def triangulate(P: Array, z: Array, R: Array) -> tuple[Gaussian, Array]:
    """Direct linear transform, then `refine`; arguments as there."""
    return refine(P, z, R, linear(P, z))


def _inverse(information: Array) -> Array:
    """Inverses (..., 3, 3); NaN where a matrix is singular or not finite."""
    good = np.asarray(np.isfinite(information).all(axis=(-2, -1)))
    safe = np.where(good[..., None, None], information, np.eye(3))
    scale = np.trace(safe, axis1=-2, axis2=-1) / 3
    good = good & (np.asarray(np.linalg.det(safe)) > 1e-15 * scale**3)
    safe = np.where(good[..., None, None], safe, np.eye(3))
    return np.where(good[..., None, None], np.linalg.inv(safe), np.nan)


def meeting_angle(P: Array, first: NDArray[np.intp], second: NDArray[np.intp], point: Array) -> Array:
    """Angle (M,) rad, 0 to pi/2, at which the rays of cameras first and second (M,) of P (C, 3, 4) meet in (M, 3)."""
    centres = -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[..., 0]
    a, b = point - centres[first], point - centres[second]
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.arctan2(sine, np.abs(np.sum(a * b, axis=-1))))


def pairs_of(cameras: list[int]) -> list[tuple[int, int]]:
    """Pairs of cameras, every one of them for up to PARTNERS + 1 cameras, and PARTNERS for each camera beyond."""
    count = len(cameras)
    if count <= PARTNERS + 1:
        return list(combinations(cameras, 2))
    reach = range(1, PARTNERS // 2 + 1)
    ring = {tuple(sorted((cameras[k], cameras[(k + step) % count]))) for k in range(count) for step in reach}
    return sorted((a, b) for a, b in ring)
