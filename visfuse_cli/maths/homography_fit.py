"""A homography from surveyed points or lines, with its covariance, and the refusal of input that cannot carry one."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from visfuse_cli.errors import InputError
from visfuse_cli.maths.homography import apply, depth, normalised
from visfuse_cli.records import Array

ENOUGH_DOF = 8  # residuals beyond the eight parameters before the noise is estimated from them
NOISE_FLOOR = 0.1  # of the stated sigma: a lucky fit must not promise more
MAX_SUBSETS = 3000
COLLINEAR = 0.02  # least width of a point set, as a share of its length


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted homography: H (3, 3), cov (9, 9) of its entries, and each item's part in it.

    errors are per item (N,): metres, image units, and metres when left out (NaN where that cannot be computed).
    """

    H: Array
    cov: Array
    ground_sign: int
    used: NDArray[np.bool_]
    error_m: Array
    error_px: Array
    leave_one_out_m: Array
    rms_m: float
    rms_px: float
    sigma_px: float
    condition: float


@dataclass(frozen=True, slots=True)
class Problem:
    """What points and lines have in common: N items, linear rows for a start, and residuals in the image."""

    count: int
    linear: Callable[[NDArray[np.intp]], Array]  # items -> H (3, 3)
    residual: Callable[[Array, NDArray[np.intp]], Array]  # H, items -> (n, 2) image units
    metres: Callable[[Array], Array]  # H -> (N,) m
    centre: Array  # (k, 2) image points that must lie on one side of the horizon
    check: Callable[[NDArray[np.intp]], str]  # items -> why they cannot carry a homography, or ''


def fit_points(
    image: Array, world: Array, sigma_px: float = 1.0, robust_px: float | None = None, condition_limit: float = 1e7
) -> Fit:
    """Homography from points (N, 2) px and (N, 2) m, N >= 4; world points are exact. Bradshaw 1997, sec. 3.1.

    `robust_px` drops points further off than that; None uses all. Raises InputError for fewer than four, equal,
    collinear or nearly degenerate points, or points on both sides of the horizon.
    """
    to_image, to_world = scaling(image), scaling(world)
    scaled_image, scaled_world = apply(to_image, image), apply(to_world, world)

    def linear(items: NDArray[np.intp]) -> Array:
        x = np.column_stack([scaled_image[items], np.ones(len(items))])
        X = scaled_world[items]
        zero = np.zeros_like(x)
        rows = np.concatenate([np.hstack([x, zero, -X[:, :1] * x]), np.hstack([zero, x, -X[:, 1:] * x])])
        return np.linalg.inv(to_world) @ null_vector(rows) @ to_image

    return fit(
        Problem(
            count=len(image),
            linear=linear,
            residual=lambda H, items: apply(np.linalg.inv(H), world[items]) - image[items],
            metres=lambda H: np.linalg.norm(apply(H, image) - world, axis=1),
            centre=image,
            check=lambda items: _points_fault(scaled_image[items], scaled_world[items], items),
        ),
        "point",
        sigma_px,
        robust_px,
        condition_limit,
    )


def fit(problem: Problem, noun: str, sigma: float, robust: float | None, condition_limit: float) -> Fit:
    everything = np.arange(problem.count)
    if problem.count < 4:
        raise InputError(f"a homography needs four {noun}s or more, not {problem.count}")
    if robust is None and (fault := problem.check(everything)):
        raise InputError(fault)
    items = everything if robust is None else _inliers(problem, robust, noun)
    if fault := problem.check(items):
        raise InputError(fault)
    H = _refine(problem, problem.linear(items), items)
    if robust is not None:
        near = np.linalg.norm(problem.residual(H, everything), axis=1) <= robust
        if near.sum() >= 4 and not problem.check(everything[near]):
            items = everything[near]
            H = _refine(problem, H, items)
    sides = np.sign(depth(H, problem.centre))
    if len(set(sides)) != 1 or 0 in sides:
        raise InputError(f"the {noun}s lie on both sides of the horizon this homography has; check their order")
    used = np.isin(everything, items)
    off = problem.residual(H, everything)
    dof = 2 * len(items) - 8
    if dof >= ENOUGH_DOF:
        sigma = max(float(np.sqrt(np.sum(off[used] ** 2) / dof)), NOISE_FLOOR * sigma)
    cov, condition = _covariance(problem, H, items, sigma)
    if condition > condition_limit:
        raise InputError(
            f"the {noun}s are nearly degenerate (condition number {condition:.1e}, limit {condition_limit:.0e}); "
            "spread them over the ground"
        )
    error_px, error_m = np.linalg.norm(off, axis=1), problem.metres(H)
    return Fit(
        H=normalised(H),
        cov=cov,
        ground_sign=int(sides[0]) * int(np.sign(_scale(H))),
        used=used,
        error_m=error_m,
        error_px=error_px,
        leave_one_out_m=_leave_one_out(problem, H, items),
        rms_m=float(np.sqrt(np.mean(error_m[used] ** 2))),
        rms_px=float(np.sqrt(np.mean(error_px[used] ** 2))),
        sigma_px=sigma,
        condition=condition,
    )


def _scale(H: Array) -> float:
    """What `normalised` multiplies H by."""
    k = np.unravel_index(np.argmax(np.abs(H)), H.shape)
    return float(normalised(H)[k] / H[k])


def scaling(points: Array) -> Array:
    """Hartley's similarity: centroid to the origin, mean distance to sqrt 2."""
    centre = points.mean(axis=0)
    size = np.mean(np.linalg.norm(points - centre, axis=1))
    s = np.sqrt(2) / size if size > 0 else 1.0
    return np.array([[s, 0, -s * centre[0]], [0, s, -s * centre[1]], [0, 0, 1]])


def null_vector(rows: Array) -> Array:
    """The matrix (3, 3) whose entries satisfy rows (m, 9) @ entries = 0 best."""
    H: Array = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    return H


def _basis(H: Array) -> tuple[Array, Array]:
    """Unit vector (9,) of H's entries and the eight directions (9, 8) at right angles to it."""
    h = H.ravel() / np.linalg.norm(H)
    return h, np.linalg.svd(h[None])[2][1:].T


def _refine(problem: Problem, H: Array, items: NDArray[np.intp]) -> Array:
    """Levenberg-Marquardt on the image error, eight parameters around the start at unit norm."""
    T = scaling(problem.centre)
    start = H @ np.linalg.inv(T)
    rows = 1 / np.maximum(np.linalg.norm(start, axis=1), 1e-300)
    h, directions = _basis(start * rows[:, None])

    def matrix(p: Array) -> Array:
        return ((h + directions @ p).reshape(3, 3) / rows[:, None]) @ T

    def off(p: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.nan_to_num(problem.residual(matrix(p), items).ravel(), nan=1e6, posinf=1e6, neginf=-1e6)

    solved = least_squares(off, np.zeros(8), method="lm" if 2 * len(items) >= 8 else "trf", xtol=1e-14, ftol=1e-14)
    return matrix(solved.x)


def _covariance(problem: Problem, H: Array, items: NDArray[np.intp], sigma: float) -> tuple[Array, float]:
    """Covariance (9, 9) of the entries at the stated scale, and the condition number of the scaled problem."""
    T = scaling(problem.centre)
    start = H @ np.linalg.inv(T)
    rows = np.maximum(np.linalg.norm(start, axis=1), 1e-300)
    _, directions = _basis(start / rows[:, None])
    # parameters -> entries of H: rows and columns unscaled again
    lift = np.stack([((d.reshape(3, 3) * rows[:, None]) @ T).ravel() for d in directions.T], axis=1)
    J = np.column_stack([_directional(problem, H, items, lift[:, k]) for k in range(8)])
    values = np.linalg.svd(J, compute_uv=False)
    condition = float(values[0] / max(values[-1], 1e-300))
    if not np.isfinite(condition) or values[-1] <= 0:
        return np.zeros((9, 9)), np.inf
    spread = lift @ (np.linalg.pinv(J) * sigma)
    scale = _scale(H)
    scaled = H * scale
    if abs(scaled[2, 2] - 1) < 1e-12:
        project = np.eye(9) - np.outer(scaled.ravel(), np.eye(9)[8])  # H22 stays 1
    else:
        project = np.eye(9) - np.outer(scaled.ravel(), scaled.ravel())  # the norm stays 1
    spread = project @ spread * scale
    return np.asarray(spread @ spread.T), condition


def _directional(problem: Problem, H: Array, items: NDArray[np.intp], direction: Array) -> Array:
    step = 1e-6 * np.linalg.norm(H) / max(np.linalg.norm(direction), 1e-300)
    step = min(step, 1e-5)
    move = direction.reshape(3, 3) * step
    return (problem.residual(H + move, items) - problem.residual(H - move, items)).ravel() / (2 * step)


def _leave_one_out(problem: Problem, H: Array, items: NDArray[np.intp]) -> Array:
    """Where each item would be mapped by the others alone, as a distance (m); NaN where they cannot tell."""
    out = np.full(problem.count, np.nan)
    for item in items if len(items) > 4 else ():
        rest = items[items != item]
        if not problem.check(rest):
            out[item] = problem.metres(_refine(problem, problem.linear(rest), rest))[item]
    return out


def _inliers(problem: Problem, threshold: float, noun: str) -> NDArray[np.intp]:
    """The largest set that agrees with a homography through four of its items; all fours, or a fixed sample of them."""
    everything = np.arange(problem.count)
    fours = itertools.combinations(range(problem.count), 4)
    subsets = np.array(list(itertools.islice(fours, 200_000)))
    if len(subsets) > MAX_SUBSETS:
        subsets = subsets[np.random.default_rng(0).choice(len(subsets), MAX_SUBSETS, replace=False)]
    best: tuple[int, float, NDArray[np.intp]] | None = None
    for four in subsets:
        if problem.check(four):
            continue
        with np.errstate(all="ignore"):
            off = np.linalg.norm(problem.residual(problem.linear(four), everything), axis=1)
        near = everything[off <= threshold]
        score = (len(near), -float(np.sum(off[near] ** 2)))
        if len(near) >= 4 and (best is None or score > best[:2]):
            best = (*score, near)
    if best is None:
        raise InputError(f"no four {noun}s agree within {threshold:g} px; check their order and units")
    return best[2]


def _points_fault(image: Array, world: Array, items: NDArray[np.intp]) -> str:
    """Why these points cannot carry a homography, or ''; rows are counted from 1."""
    for points, where in ((image, "in the image"), (world, "on the ground")):
        distance = np.linalg.norm(points[:, None] - points[None], axis=2) + 10 * np.eye(len(points))
        if distance.min() < 1e-6:
            a, b = np.unravel_index(np.argmin(distance), distance.shape)
            return f"points {items[a] + 1} and {items[b] + 1} are the same point {where}"
        if _width(points) < COLLINEAR:
            return f"the points lie on one line {where}; spread them over the ground"
        left_out = range(len(points))
        if any(_width(np.delete(points, k, axis=0)) < COLLINEAR / 4 for k in left_out):
            return f"all points but one lie on one line {where}; a homography needs four, no three of them on a line"
    return ""


def _width(points: Array) -> float:
    """Extent of a point set across its longest direction, as a share of its length."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(values[-1] / max(values[0], 1e-300)) if len(points) > 2 else 1.0
