"""A homography from lines: the dual of points (Bradshaw 1997, sec. 3.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.errors import InputError
from visfuse_cli.maths.homography import apply
from visfuse_cli.maths.homography_fit import Fit, Problem, fit, null_vector, scaling
from visfuse_cli.records import Array

CONCURRENT = 0.02  # least volume of a set of unit lines that does not share one point


def through(segments: Array) -> Array:
    """Unit-normal line coordinates (N, 3) through two points each, segments (N, 4)."""
    ends = np.concatenate([segments.reshape(-1, 2), np.ones((2 * len(segments), 1))], axis=1).reshape(-1, 2, 3)
    lines = np.cross(ends[:, 0], ends[:, 1])
    return np.asarray(lines / np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-300))


def fit_lines(
    image: Array, world: Array, sigma_px: float = 1.0, robust_px: float | None = None, condition_limit: float = 1e7
) -> Fit:
    """Homography from lines (N, 4) px and (N, 4) m, two points anywhere on each, N >= 4; world lines are exact.

    u = M^T U maps the world line U to the image line u; refined on the distances of the image line's two points to
    the mapped world line. Raises InputError for fewer than four, lines without length, or lines through a common
    point. Bradshaw 1997, sec. 3.2.
    """
    for segments, where in ((image, "in the image"), (world, "on the ground")):
        for row in np.flatnonzero(np.hypot(*(segments[:, 2:] - segments[:, :2]).T) < 1e-9):
            raise InputError(f"line {row + 1} has no length {where}: its two points are the same")
    points = image.reshape(-1, 2)
    to_image, to_world = scaling(points), scaling(world.reshape(-1, 2))
    u = through(apply(to_image, points).reshape(-1, 4))
    U = through(apply(to_world, world.reshape(-1, 2)).reshape(-1, 4))
    u_unit, U_unit = (lines / np.linalg.norm(lines, axis=1, keepdims=True) for lines in (u, U))
    world_lines = through(world)

    def linear(items: NDArray[np.intp]) -> Array:
        # u x (M^T U) = 0, row by row in the entries of M
        rows = []
        for a, b in zip(u_unit[items], U_unit[items], strict=True):
            cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
            rows.append(np.einsum("kj,i->kij", cross, b).reshape(3, 9))
        return np.linalg.inv(to_world) @ null_vector(np.concatenate(rows)) @ to_image

    def residual(H: Array, items: NDArray[np.intp]) -> Array:
        mapped = world_lines[items] @ H  # u = M^T U
        mapped = mapped / np.linalg.norm(mapped[:, :2], axis=1, keepdims=True)
        ends = image[items].reshape(-1, 2, 2)
        return np.asarray(np.einsum("nki,ni->nk", ends, mapped[:, :2]) + mapped[:, 2:])

    def metres(H: Array) -> Array:
        on_ground = apply(H, points).reshape(-1, 2, 2)
        off = np.einsum("nki,ni->nk", on_ground, world_lines[:, :2]) + world_lines[:, 2:]
        return np.asarray(np.sqrt(np.mean(off**2, axis=1)))

    problem = Problem(
        count=len(image),
        linear=linear,
        residual=residual,
        metres=metres,
        centre=points,
        check=lambda items: _lines_fault(u_unit[items], U_unit[items], items),
    )
    return fit(problem, "line", sigma_px, robust_px, condition_limit)


def _lines_fault(image: Array, world: Array, items: NDArray[np.intp]) -> str:
    """Why these lines cannot carry a homography, or ''."""
    for lines, where in ((image, "in the image"), (world, "on the ground")):
        cosine = np.abs(lines @ lines.T) - 2 * np.eye(len(lines))
        if cosine.max() > 1 - 1e-9:
            a, b = np.unravel_index(np.argmax(cosine), cosine.shape)
            return f"lines {items[a] + 1} and {items[b] + 1} are the same line {where}"
        if _spread(lines) < CONCURRENT:
            return f"the lines are parallel or go through one point {where}; a homography needs lines that cross apart"
        if any(_spread(np.delete(lines, k, axis=0)) < CONCURRENT / 4 for k in range(len(lines))):
            return (
                f"all lines but one are parallel or go through one point {where}; "
                "a homography needs four, no three of them through one point"
            )
    return ""


def _spread(lines: Array) -> float:
    values = np.linalg.svd(lines, compute_uv=False)
    return float(values[2] / values[0])
