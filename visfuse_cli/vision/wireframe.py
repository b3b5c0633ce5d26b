"""A vehicle as a box on the ground plane, fitted to its outline in the image (Lou 2002, sec. 2, pose refinement).

An outline is a set of rows. Each says how far out, along one image direction, a point of the projected wireframe was
seen: a point on one of its edges (found by `contour.search`), or whichever corner lies outermost (the tangents of a
region). All boxes are fitted at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from visfuse_cli.records import Array, GroundCamera

DIRECTIONS = 24
FAN = np.column_stack([np.cos(a := np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS), np.sin(a)])  # (K, 2)
AXES = np.arange(DIRECTIONS) % (DIRECTIONS // 4) == 0  # the four sides of an upright box
_SIGNS = np.array([[i, j, k] for k in (0, 1) for i in (-1, 1) for j in (-1, 1)], dtype=float)
_HALF = _SIGNS * [0.5, 0.5, 1.0]  # corners of a box of unit size
# The world coordinates (4, 8 terms, 8 corners), homogeneous, that each term of a box adds to its corners (see _terms).
_IN_TERMS = np.zeros((4, 8, 8))
_IN_TERMS[0, 0] = _IN_TERMS[1, 1] = _IN_TERMS[3, 7] = 1
_IN_TERMS[0, 2] = _IN_TERMS[1, 3] = _HALF[:, 0]
_IN_TERMS[0, 5], _IN_TERMS[1, 4], _IN_TERMS[2, 6] = -_HALF[:, 1], _HALF[:, 1], _HALF[:, 2]
_SLOPES = np.zeros((7, 8))  # d terms / d (x, y, theta, l, w, h) as far as they are the same for every box
_SLOPES[0, 0] = _SLOPES[1, 1] = _SLOPES[5, 6] = 1
EDGES = np.array(
    [(0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7)],
    np.int8,  # every frame of every track keeps some
)
# The faces that meet in each edge: rear, front, right, left, bottom, top.
_MEET = np.array([(0, 4), (3, 4), (1, 4), (2, 4), (0, 5), (3, 5), (1, 5), (2, 5), (0, 2), (0, 3), (1, 2), (1, 3)])

BEFORE = 1e-9  # depth of what lies before the camera
SETTLED = 1e-3  # m and rad: a smaller step changes nothing


@dataclass(frozen=True, slots=True)
class Outlines:
    """Rows of N outlines: model point (1 - share) corner[0] + share corner[1] was seen `support` px along `normal`.

    normal (N, K, 2), support (N, K), corner (N, K, 2), share (N, K), valid (N, K): the thing's own border was seen;
    tangent (N,): the corner is whichever lies outermost; width (N,) px: mean width of the outline; dark (N, K) m: how
    high above its end that begins where the row was seen which looks like shadow, inf where no end is seen, NaN where
    nothing dark begins; paint (N, K) m: how far below it the last paint is, 0 where there is none, inf where it may go
    on, NaN where that was not looked for. One outline has the same fields without the first axis.
    """

    normal: Array
    support: Array
    corner: np.ndarray
    share: Array
    valid: np.ndarray
    tangent: np.ndarray
    width: Array
    dark: Array
    paint: Array

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


def projected(camera: GroundCamera, pose: Array, size: Array) -> Array:
    """The corners of N boxes as the camera sees them, (2, N, 8) px; NaN at or behind the camera."""
    terms = np.empty((len(pose), 8))
    _terms(pose, size, np.cos(pose[:, 2]), np.sin(pose[:, 2]), terms)
    image = (terms @ _seen_terms(camera)).reshape(-1, 3, 8).swapaxes(0, 1)
    return np.asarray(image[:2] / np.where(image[2] > BEFORE, image[2], np.nan))


def _terms(pose: Array, size: Array, c: Array, s: Array, out: Array) -> None:
    """What the corners of N boxes are linear in, (N, 8): x, y, l c, l s, w c, w s, h and 1, of heading cosines c (N,)
    and sines s (N,)."""
    out[:, :2], out[:, 6], out[:, 7] = pose[:, :2], size[:, 2], 1
    out[:, 2], out[:, 3] = size[:, 0] * c, size[:, 0] * s
    out[:, 4], out[:, 5] = size[:, 1] * c, size[:, 1] * s


def _seen_terms(camera: GroundCamera) -> Array:
    """From the terms of a box to its corners in the image, homogeneous: (8, 24), u, v and depth of eight each."""
    return _seen_through(camera.image_from_world.tobytes())


@lru_cache(maxsize=8)
def _seen_through(projection: bytes) -> Array:
    return np.asarray(
        (np.frombuffer(projection).reshape(3, 4) @ _IN_TERMS.reshape(4, 64))
        .reshape(3, 8, 8)
        .swapaxes(0, 1)
        .reshape(8, 24)
    )


def _linearised(seen: Array, x: Array, slopes: Array) -> Array:
    """The corners of N boxes x (N, 6) and their derivatives: (N, 7, 16) px, eight u and then eight v of each.

    `seen` are the camera's `_seen_terms`; the rows are d / d (x, y, theta, l, w, h) and the corners themselves. Of
    `slopes` (N, 7, 8), the derivatives of the terms, those that do not change are there already.
    """
    c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
    _terms(x[:, :3], x[:, 3:], c, s, slopes[:, 6])
    terms = slopes[:, 6]
    slopes[:, 2, 2], slopes[:, 2, 3], slopes[:, 2, 4], slopes[:, 2, 5] = (
        -terms[:, 3],
        terms[:, 2],
        -terms[:, 5],
        terms[:, 4],
    )
    slopes[:, 3, 2] = slopes[:, 4, 4] = c
    slopes[:, 3, 3] = slopes[:, 4, 5] = s
    image = (slopes.reshape(-1, 8) @ seen).reshape(len(x), 7, 3, 8)
    depth = image[:, 6:, 2:].copy()
    behind = ~(depth > BEFORE)
    if behind.any():
        depth[behind] = np.nan
    image /= depth
    pixels = image[:, 6:, :2]
    image[:, :6, :2] -= pixels * image[:, :6, 2:]
    if behind.any():
        image[:, :6], image[:, 6] = np.nan_to_num(image[:, :6]), np.nan_to_num(image[:, 6], nan=-1e9)
    return image[:, :, :2].reshape(len(x), 7, 16)


def downwards(camera: GroundCamera, pose: Array, size: Array) -> Array:
    """What a metre down is in the picture (2, N) px, beside N boxes."""
    pixels = projected(camera, pose, size)
    return np.asarray((pixels[..., :4] - pixels[..., 4:]).mean(axis=2) / size[:, 2])


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
    unknown = np.full(DIRECTIONS, np.nan)
    return Outlines(FAN, support, nowhere, np.zeros(DIRECTIONS), valid, np.asarray(True), width, unknown, unknown)


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
    valid, noise = outlines.valid, np.asarray(sigma_px, dtype=float)[:, None]
    rows, seen, slopes = _rows(outlines), _seen_terms(camera), np.tile(_SLOPES, (len(x), 1, 1))
    trust, far = valid / noise**2, 1 / (3 * noise) ** 2
    N, residual = np.zeros(0), np.zeros(0)
    for _ in range(iterations):
        image = _linearised(seen, x, slopes)
        if outlines.tangent.any():
            rows[outlines.tangent] = _outermost(outlines[outlines.tangent], image[outlines.tangent, 6])
        J = rows @ image.swapaxes(1, 2)  # (N, K, 7): the last column is where each row is expected
        residual = J[..., 6] = outlines.support - J[..., 6]
        # A Cauchy weight: a mirror, a patch of shadow or a missing corner moves one row, not the box.
        robust = trust / (1 + residual * residual * far)
        normal_equations = (robust[..., None] * J[..., :6]).swapaxes(1, 2) @ J
        N = normal_equations[..., :6]
        diagonal = np.einsum("nii->ni", N)
        diagonal += weight
        diagonal += 1e-9 * diagonal.sum(axis=1, keepdims=True)
        gradient = normal_equations[..., 6] + weight * (prior - x)
        step = np.linalg.solve(N, gradient[..., None])[..., 0]
        limit = np.minimum(1, 2.0 / np.maximum(np.sqrt(step[:, 0] ** 2 + step[:, 1] ** 2), 1e-9))
        x = x + step * limit[:, None]
        x[:, 3:] = np.maximum(x[:, 3:], 0.2)
        if np.abs(step).max() < SETTLED:
            break
    seen_rows = np.maximum(valid.sum(axis=1), 1)
    rms = np.sqrt(np.sum(np.where(valid, residual**2, 0), axis=1) / seen_rows)
    ok = (valid.sum(axis=1) >= 3) & np.isfinite(x).all(axis=1)
    agreed = np.sum(valid & (np.abs(residual) < 3 * noise), axis=1) / seen_rows
    return BoxFit(x[:, :3], x[:, 3:], np.asarray(np.linalg.inv(N)), rms, agreed, ok)


def _rows(outlines: Outlines) -> Array:
    """How far out N outlines expect the points of their rows, by corners: (N, K, 16), of eight u and then eight v."""
    count, directions = outlines.share.shape
    shares = np.zeros((count, directions, 1, 8))
    n, k = np.arange(count)[:, None], np.arange(directions)
    shares[n, k, 0, outlines.corner[..., 0]] = 1 - outlines.share
    shares[n, k, 0, outlines.corner[..., 1]] = outlines.share
    return np.asarray((outlines.normal[..., None] * shares).reshape(count, directions, 16))


def _outermost(outlines: Outlines, image: Array) -> Array:
    """The rows (n, K, 16) of tangents to n boxes whose corners are at `image` (n, 16) px."""
    furthest = np.argmax(image.reshape(-1, 2, 8).swapaxes(1, 2) @ outlines.normal.swapaxes(1, 2), axis=1)
    return np.asarray((outlines.normal[..., None] * np.eye(8)[furthest][:, :, None]).reshape(*furthest.shape, 16))


def silhouette(camera: GroundCamera, pose: Array, size: Array) -> Array:
    """Outline (k, 2) px of one box: the hull of its projected corners, empty when it is behind the camera."""
    pixels = projected(camera, pose[None], size[None])[:, 0].T
    if not np.isfinite(pixels).all():
        return np.zeros((0, 2))
    return np.asarray(cv2.convexHull(pixels.astype(np.float32)), dtype=float).reshape(-1, 2)
