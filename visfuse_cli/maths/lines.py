"""A homography from lines: the dual of points (Bradshaw 1997, sec. 3.2)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.maths.homography import apply
from visfuse_cli.maths.homography_fit import CONDITION_LIMIT, Fit, Items, Problem, fit, null_vector, scaling
from visfuse_cli.records import Array

CONCURRENT = 0.02  # least volume of a set of unit lines that does not share one point


def through(segments: Array) -> Array:
    """Unit-normal line coordinates (N, 3) through two points each, segments (N, 4)."""
    ends = np.concatenate([segments.reshape(-1, 2), np.ones((2 * len(segments), 1))], axis=1).reshape(-1, 2, 3)
    lines = np.cross(ends[:, 0], ends[:, 1])
    return np.asarray(lines / np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-300))


def fit_lines(
    image: Array,
    world: Array,
    sigma: float = 1.0,
    robust: float | None = None,
    condition_limit: float = CONDITION_LIMIT,
) -> Fit:
    """Homography from lines (N, 4) px and (N, 4) m, two points anywhere on each, N >= 4; world lines are exact.

    u = M^T U maps the world line U to the image line u; refined on the distances of the image line's two points to
    the mapped world line. Raises InputError for fewer than four, lines without length, or lines through a common
    point. Bradshaw 1997, sec. 3.2.
    """
    for segments, where in ((image, "in the image"), (world, "on the ground")):
        for row in np.flatnonzero(np.hypot(*(segments[:, 2:] - segments[:, :2]).T) < 1e-9):
            raise InputError(f"line {row + 1} has no length {where}: its two points are the same")
    to_image, to_world = scaling(image.reshape(-1, 2)), scaling(world.reshape(-1, 2))
    marks = apply(to_image, image.reshape(-1, 2)).reshape(-1, 2, 2)
    u = through(marks.reshape(-1, 4))
    U = through(apply(to_world, world.reshape(-1, 2)).reshape(-1, 4))
    u_unit, U_unit = (lines / np.linalg.norm(lines, axis=1, keepdims=True) for lines in (u, U))

    def linear(items: Items) -> Array:
        # u x (M^T U) = 0, row by row in the entries of M
        a, zero = u_unit[items], np.zeros(len(items))
        cross = np.array([[zero, -a[:, 2], a[:, 1]], [a[:, 2], zero, -a[:, 0]], [-a[:, 1], a[:, 0], zero]])
        return null_vector(np.einsum("kjn,ni->nkij", cross, U_unit[items]).reshape(-1, 9))

    def residual(H: Array, items: Items) -> Array:
        return _distances(marks[items], U[items] @ H) / to_image[0, 0]  # u = M^T U

    def metres(H: Array) -> Array:
        on_ground = apply(H, marks.reshape(-1, 2)).reshape(-1, 2, 2)
        return np.sqrt(np.mean(_distances(on_ground, U) ** 2, axis=1)) / to_world[0, 0]

    problem = Problem(
        noun="line",
        to_image=to_image,
        to_world=to_world,
        marks=marks,
        linear=linear,
        residual=residual,
        metres=metres,
        fault=lambda items: _lines_fault(u_unit[items], U_unit[items], items),
    )
    found = fit(problem, sigma, robust, condition_limit)
    rms = math.sqrt(0.5)  # of the two distances of a line
    return replace(found, error_px=found.error_px * rms, rms_px=found.rms_px * rms)


def _distances(points: Array, lines: Array) -> Array:
    """Signed distances (n, 2) of two points each (n, 2, 2) from lines (n, 3)."""
    normal = np.linalg.norm(lines[:, :2], axis=1)
    return np.asarray((np.einsum("nki,ni->nk", points, lines[:, :2]) + lines[:, 2:]) / normal[:, None])


def _lines_fault(image: Array, world: Array, items: Items) -> str:
    """Why these unit lines (n, 3) cannot carry a homography, or ''; `items` (n,) name their rows, from 0."""
    for lines, where in ((image, "in the image"), (world, "on the ground")):
        cosine = np.abs(lines @ lines.T) - 2 * np.eye(len(lines))
        if cosine.max() > 1 - 1e-9:
            a, b = np.unravel_index(np.argmax(cosine), cosine.shape)
            return f"lines {items[a] + 1} and {items[b] + 1} are the same line {where}"
        moments = lines.T @ lines
        if _volume(moments) < CONCURRENT:
            return f"the lines are parallel or go through one point {where}; a homography needs lines that cross apart"
        if np.any(_volume(moments - lines[:, :, None] * lines[:, None, :]) < CONCURRENT / 4):
            return (
                f"all lines but one are parallel or go through one point {where}; "
                "a homography needs four, no three of them through one point"
            )
    return ""


def _volume(moments: Array) -> Array:
    """How far lines are from sharing a point, from their second moments (..., 3, 3)."""
    values = np.linalg.eigvalsh(moments)
    return np.asarray(np.sqrt(np.clip(values[..., 0], 0, None) / np.maximum(values[..., -1], 1e-300)))
