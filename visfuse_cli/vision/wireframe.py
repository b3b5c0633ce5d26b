"""A vehicle as a box on the ground plane, fitted to its outline in the image (Lou 2002, sec. 2, pose refinement).

An outline is a set of rows. Each says how far out, along one image direction, a point of the projected wireframe was
seen: a point on one of its edges (found by `contour.search`), or whichever corner lies outermost (the tangents of a
region). All boxes are fitted at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from visfuse_cli.maths.cameras import project
from visfuse_cli.records import Array, GroundCamera

DIRECTIONS = 24
FAN = np.column_stack([np.cos(a := np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS), np.sin(a)])  # (K, 2)
AXES = np.arange(DIRECTIONS) % (DIRECTIONS // 4) == 0  # the four sides of an upright box
_SIGNS = np.array([[i, j, k] for k in (0, 1) for i in (-1, 1) for j in (-1, 1)], dtype=float)
_HALF = _SIGNS * [0.5, 0.5, 1.0]  # corners of a box of unit size
EDGES = np.array(
    [(0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7)],
    np.int8,  # every frame of every track keeps some
)
# The faces that meet in each edge: rear, front, right, left, bottom, top.
_MEET = np.array([(0, 4), (3, 4), (1, 4), (2, 4), (0, 5), (3, 5), (1, 5), (2, 5), (0, 2), (0, 3), (1, 2), (1, 3)])

SETTLED = 1e-3  # m and rad: a smaller step changes nothing


@dataclass(frozen=True, slots=True)
class Outlines:
    """Rows of N outlines: model point (1 - share) corner[0] + share corner[1] was seen `support` px along `normal`.

    normal (N, K, 2), support (N, K), corner (N, K, 2), share (N, K), valid (N, K): the thing's own border was seen;
    tangent (N,): the corner is whichever lies outermost; width (N,) px: mean width of the outline. One outline has
    the same fields without the first axis.
    """

    normal: Array
    support: Array
    corner: np.ndarray
    share: Array
    valid: np.ndarray
    tangent: np.ndarray
    width: Array

    def __getitem__(self, which: object) -> Outlines:
        return Outlines(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    @staticmethod
    def stack(outlines: Sequence[Outlines]) -> Outlines:
        """N outlines as one."""
        return Outlines(*(np.stack([getattr(o, name) for o in outlines]) for name in Outlines.__dataclass_fields__))

    @staticmethod
    def joined(outlines: Sequence[Outlines]) -> Outlines:
        """Several sets of outlines as one."""
        return Outlines(
            *(np.concatenate([getattr(o, name) for o in outlines]) for name in Outlines.__dataclass_fields__)
        )


@dataclass(frozen=True, slots=True)
class BoxFit:
    """Fitted boxes: pose (N, 3) x, y m and theta rad; size (N, 3) l, w, h m; cov (N, 6, 6); rms (N,) px; ok (N,).

    agreed (N,) is the share of an outline's seen rows that lie within three deviations of the fitted box.
    """

    pose: Array
    size: Array
    cov: Array
    rms: Array
    agreed: Array
    ok: np.ndarray

    def __getitem__(self, which: object) -> BoxFit:
        return BoxFit(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def corners(pose: Array, size: Array) -> Array:
    """The eight corners (..., 8, 3) m of boxes with pose (..., 3) and size (..., 3); bottom four first."""
    local = _HALF * size[..., None, :]
    c, s = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    placed = local.copy()
    placed[..., 0] = pose[..., 0, None] + c * local[..., 0] - s * local[..., 1]
    placed[..., 1] = pose[..., 1, None] + s * local[..., 0] + c * local[..., 1]
    return placed


def _corner_jacobian(pose: Array, size: Array) -> Array:
    """d corner / d (x, y, theta, l, w, h): (N, 8, 3, 6)."""
    half = _HALF
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


def silhouette_edges(camera: GroundCamera, pose: Array, size: Array) -> np.ndarray:
    """Which of the EDGES (N, 12) border the silhouette: one of the two faces that meet there is seen, one is not."""
    offset = camera.centre - np.concatenate([pose[:, :2], np.zeros((len(pose), 1))], axis=1)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    along, across = c * offset[:, 0] + s * offset[:, 1], -s * offset[:, 0] + c * offset[:, 1]
    length, width, height = size.T
    seen = np.stack(
        [
            along < -length / 2,
            along > length / 2,
            across < -width / 2,
            across > width / 2,
            offset[:, 2] < 0,
            offset[:, 2] > height,
        ],
        axis=1,
    )
    return np.asarray(seen[:, _MEET[:, 0]] != seen[:, _MEET[:, 1]])


def tangents(hull: Array, at_border: np.ndarray, upright: bool = False, border_px: float = 0.0) -> Outlines:
    """One outline of a hull (k, 2) px: its support in the fan's directions, moved out by `border_px`.

    Directions whose tangent touches the hull `at_border` (k,) see the frame's edge and not the vehicle; of an upright
    detection box only its four sides count.
    """
    reach = hull @ FAN.T
    outermost = np.argmax(reach, axis=0)
    valid = ~at_border[outermost]
    if upright:
        valid &= AXES
    support = reach[outermost, np.arange(DIRECTIONS)] + border_px
    nowhere = np.zeros((DIRECTIONS, 2), dtype=int)
    width = np.asarray(2 * support.mean())
    return Outlines(FAN, support, nowhere, np.zeros(DIRECTIONS), valid, np.asarray(True), width)


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
    theta the predicted heading's; sigma_px (N,) is the noise of each outline's rows. Lou 2002, sec. 2 and 4.1.
    """
    prior = np.concatenate([pose, size], axis=1)
    weight = 1 / np.concatenate([pose_sigma, size_sigma], axis=1) ** 2
    x = prior.copy()
    valid, normal = outlines.valid, outlines.normal
    noise = np.asarray(sigma_px, dtype=float)[:, None]
    shares = _corner_shares(outlines)
    N, residual = np.zeros(0), np.zeros(0)
    for _ in range(iterations):
        pixels, J_pixel = project(camera, corners(x[:, :3], x[:, 3:]))
        if not np.isfinite(pixels).all():
            pixels, J_pixel = np.nan_to_num(pixels, nan=-1e9), np.nan_to_num(J_pixel)
        if outlines.tangent.any():
            outermost = np.argmax(pixels @ normal.swapaxes(1, 2), axis=1)
            shares[outlines.tangent] = np.eye(8)[outermost[outlines.tangent]]
        at = shares @ pixels
        residual = outlines.support - (at[..., 0] * normal[..., 0] + at[..., 1] * normal[..., 1])
        J_corner = J_pixel @ _corner_jacobian(x[:, :3], x[:, 3:])  # (N, 8, 2, 6)
        J_at = (shares @ J_corner.reshape(len(x), 8, 12)).reshape(*residual.shape, 2, 6)
        J = normal[..., :1] * J_at[..., 0, :] + normal[..., 1:] * J_at[..., 1, :]
        # A Cauchy weight: a mirror, a patch of shadow or a missing corner moves one row, not the box.
        robust = valid / (1 + (residual / (3 * noise)) ** 2) / noise**2
        weighted = (robust[..., None] * J).swapaxes(1, 2)
        N = weighted @ J
        diagonal = np.einsum("nii->ni", N)
        diagonal += weight
        diagonal += 1e-9 * diagonal.sum(axis=1, keepdims=True)
        gradient = (weighted @ residual[..., None])[..., 0] + weight * (prior - x)
        step = np.linalg.solve(N, gradient[..., None])[..., 0]
        limit = np.minimum(1, 2.0 / np.maximum(np.linalg.norm(step[:, :2], axis=1), 1e-9))
        x = x + step * limit[:, None]
        x[:, 3:] = np.maximum(x[:, 3:], 0.2)
        if np.abs(step).max() < SETTLED:
            break
    seen = valid.sum(axis=1)
    rms = np.sqrt(np.sum(np.where(valid, residual**2, 0), axis=1) / np.maximum(seen, 1))
    ok = (seen >= 3) & np.all(np.isfinite(x), axis=1)
    agreed = np.sum(valid & (np.abs(residual) < 3 * noise), axis=1) / np.maximum(seen, 1)
    return BoxFit(x[:, :3], x[:, 3:], np.asarray(np.linalg.inv(N)), rms, agreed, ok)


def _corner_shares(outlines: Outlines) -> Array:
    """How much (N, K, 8) of each corner is in the model points of N outlines."""
    shares = np.zeros((*outlines.share.shape, 8))
    n, k = np.ix_(*map(range, outlines.share.shape))
    shares[n, k, outlines.corner[..., 0]] = 1 - outlines.share
    shares[n, k, outlines.corner[..., 1]] = outlines.share
    return shares


def silhouette(camera: GroundCamera, pose: Array, size: Array) -> Array:
    """Outline (k, 2) px of one box: the hull of its projected corners, empty when it is behind the camera."""
    pixels, _ = project(camera, corners(pose, size))
    if not np.isfinite(pixels).all():
        return np.zeros((0, 2))
    return np.asarray(cv2.convexHull(pixels.astype(np.float32)), dtype=float).reshape(-1, 2)
