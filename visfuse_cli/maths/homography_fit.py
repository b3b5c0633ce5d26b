"""A homography from surveyed points or lines, with its covariance, and the refusal of input that cannot carry one.

Everything between the input and the result happens in Hartley's coordinates, where eight parameters about a unit
vector of entries are well scaled wherever the world's origin lies.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from visfuse_cli.errors import InputError
from visfuse_cli.maths.homography import apply, depth, invert, on_horizon
from visfuse_cli.records import Array

Items = NDArray[np.intp]

ENOUGH_DOF = 8  # residuals beyond the eight parameters before the noise is estimated from them alone
NOISE_FLOOR = 0.1  # of the stated sigma: a lucky fit must not promise more
MAX_SUBSETS = 1000
MANY = 300  # items beyond which leaving one out tells nothing and costs much
COLLINEAR = 0.02  # least width of a point set, as a share of its length
CONDITION_LIMIT = 1e5


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted homography: H (3, 3), cov (9, 9) of its entries, and each item's part in it.

    Per item (N,): error_m in metres, error_px in image units, leave_one_out_m how far (m) the fit to the others misses
    it (NaN where they cannot tell). `sigma_px` is the image noise the covariance stands on.
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
    """What points and lines have in common: N items, linear rows for a start, and residuals in the image.

    H is the map between the scaled planes: ground_from_image = inverse(to_world) @ H @ to_image.
    """

    noun: str
    to_image: Array  # Hartley's similarities
    to_world: Array
    marks: Array  # (N, k, 2) scaled image points; those in use must lie on one side of the horizon
    linear: Callable[[Items], Array]  # items -> H (3, 3)
    residual: Callable[[Array, Items], Array]  # H, items -> (n, 2) in the unit of the image noise
    metres: Callable[[Array], Array]  # H -> (N,) m
    fault: Callable[[Items], str]  # items -> why they cannot carry a homography, or ''


def fit_points(
    image: Array,
    world: Array,
    sigma: float = 1.0,
    robust: float | None = None,
    condition_limit: float = CONDITION_LIMIT,
    measured: Callable[[Array], Array] = np.asarray,
) -> Fit:
    """Homography from points (N, 2) px and (N, 2) m, N >= 4; world points are exact. Bradshaw 1997, sec. 3.1.

    `robust` drops points further off than that; None uses all. `measured` takes image points to what carries the noise
    `sigma`, where that is not the point itself (gaze angles). Raises InputError for fewer than four, equal, collinear
    or nearly degenerate points, or points on both sides of the horizon.
    """
    to_image, to_world = scaling(image), scaling(world)
    x, X = apply(to_image, image), apply(to_world, world)
    seen, from_scaled = measured(image), np.linalg.inv(to_image)

    def linear(items: Items) -> Array:
        h = np.column_stack([x[items], np.ones(len(items))])
        zero = np.zeros_like(h)
        rows = [np.hstack([h, zero, -X[items, :1] * h]), np.hstack([zero, h, -X[items, 1:] * h])]
        return null_vector(np.concatenate(rows))

    problem = Problem(
        noun="point",
        to_image=to_image,
        to_world=to_world,
        marks=x[:, None],
        linear=linear,
        residual=lambda H, items: measured(apply(from_scaled @ invert(H), X[items])) - seen[items],
        metres=lambda H: np.linalg.norm(apply(H, x) - X, axis=1) / to_world[0, 0],
        fault=lambda items: points_fault(x[items], X[items], items),
    )
    return fit(problem, sigma, robust, condition_limit)


def fit(problem: Problem, sigma: float, robust: float | None, condition_limit: float) -> Fit:
    """Start linearly, refine in the image, state the covariance; raises InputError as `fit_points` does."""
    count, noun = len(problem.marks), problem.noun
    if count < 4:
        raise InputError(f"a homography needs four {noun}s or more, not {count}")
    everything = np.arange(count)
    with np.errstate(all="ignore"):
        items = everything if robust is None else _agreeing(problem, robust)
        if fault := problem.fault(items):
            raise InputError(fault)
        H = _refine(problem, problem.linear(items), items)
        off = problem.residual(H, everything)
    sides = np.sign(depth(H, problem.marks[items].reshape(-1, 2)))
    if np.any(sides != sides[0]) or sides[0] == 0:
        raise InputError(f"the {noun}s lie on both sides of the horizon of this homography; check their order")
    used = np.isin(everything, items)
    sigma = _noise(off[used], sigma)
    spread, condition = _spread(problem, H, items, sigma)
    if not condition <= condition_limit:
        raise InputError(
            f"the {noun}s are nearly degenerate (condition number {condition:.1e}, limit {condition_limit:.0e}); "
            "spread them over the ground"
        )
    stated, cov, sign = _stated(problem, H, spread)
    error_px, error_m = np.linalg.norm(off, axis=1), problem.metres(H)
    return Fit(
        H=stated,
        cov=cov,
        ground_sign=sign * int(sides[0]),
        used=used,
        error_m=error_m,
        error_px=error_px,
        leave_one_out_m=_leave_one_out(problem, H, items),
        rms_m=float(np.sqrt(np.mean(error_m[used] ** 2))),
        rms_px=float(np.sqrt(np.mean(error_px[used] ** 2))),
        sigma_px=sigma,
        condition=condition,
    )


def scaling(points: Array) -> Array:
    """Hartley's similarity: centroid to the origin, mean distance to sqrt 2."""
    centre = points.mean(axis=0)
    size = float(np.mean(np.linalg.norm(points - centre, axis=1)))
    s = math.sqrt(2) / size if size > 0 else 1.0
    return np.array([[s, 0, -s * centre[0]], [0, s, -s * centre[1]], [0, 0, 1]])


def null_vector(rows: Array) -> Array:
    """The matrix (3, 3) of unit norm whose entries satisfy rows (m, 9) @ entries = 0 best."""
    H: Array = np.linalg.svd(rows, full_matrices=len(rows) < 9)[2][-1].reshape(3, 3)
    return H


def _chart(H: Array) -> tuple[Array, Array]:
    """Unit vector (9,) of H's entries and the eight directions (9, 8) at right angles to it."""
    h = H.ravel() / np.linalg.norm(H)
    return h, np.linalg.svd(h[None])[2][1:].T


def _refine(problem: Problem, H: Array, items: Items) -> Array:
    """Levenberg-Marquardt on the image error: eight parameters around the start."""
    h, directions = _chart(H)

    def off(p: Array) -> Array:
        residual = problem.residual((h + directions @ p).reshape(3, 3), items).ravel()
        return np.nan_to_num(residual, nan=1e6, posinf=1e6, neginf=-1e6)

    solved = least_squares(off, np.zeros(8), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return np.asarray((h + directions @ solved.x).reshape(3, 3))


def _noise(off: Array, stated: float) -> float:
    """Image noise from residuals off (n, 2): theirs where there are enough, else the stated one or what they add to it.

    With few residuals the stated sigma weighs as much as ENOUGH_DOF of them; small ones cannot lower it.
    """
    dof, squares = off.size - 8, float(np.sum(off**2))
    if dof >= ENOUGH_DOF:
        return max(math.sqrt(squares / dof), NOISE_FLOOR * stated)
    return max(math.sqrt((ENOUGH_DOF * stated**2 + squares) / (ENOUGH_DOF + dof)), stated)


def _spread(problem: Problem, H: Array, items: Items, sigma: float) -> tuple[Array, float]:
    """Square root (9, n) of the covariance of H's entries at unit norm, and the condition number."""
    h, directions = _chart(H)
    step = 1e-6
    columns = [
        problem.residual((h + step * d).reshape(3, 3), items) - problem.residual((h - step * d).reshape(3, 3), items)
        for d in directions.T
    ]
    J = np.stack([column.ravel() for column in columns], axis=1) / (2 * step)
    if not np.isfinite(J).all():
        return np.zeros((9, 0)), math.inf
    values = np.linalg.svd(J, compute_uv=False)
    condition = float(values[0] / values[-1]) if values[-1] > 0 else math.inf
    return directions @ np.linalg.pinv(J) * sigma, condition


def _stated(problem: Problem, H: Array, spread: Array) -> tuple[Array, Array, int]:
    """H, the covariance of its entries (9, 9) between the planes themselves at the stated scale, the scale's sign."""
    from_scaled = np.linalg.inv(problem.to_world)
    whole = from_scaled @ (H / np.linalg.norm(H)) @ problem.to_image
    marks = apply(np.asarray(np.linalg.inv(problem.to_image)), problem.marks.reshape(-1, 2))
    size = np.linalg.norm(whole) if (unit_norm := on_horizon(whole, marks)) else whole[2, 2]
    whole = whole / size
    spread = np.kron(from_scaled, problem.to_image.T) @ spread / size  # vec(A X B) = (A kron B^T) vec(X), row by row
    held = whole.ravel() if unit_norm else np.eye(9)[8]  # noise leaves the scale as it is
    spread = spread - np.outer(whole.ravel(), held @ spread)
    return whole, np.asarray(spread @ spread.T), int(np.sign(size))


def _leave_one_out(problem: Problem, H: Array, items: Items) -> Array:
    """How far (m) the fit to the others misses each item (N,); NaN where they cannot tell, or are very many."""
    out = np.full(len(problem.marks), np.nan)
    if not 4 < len(items) <= MANY:
        return out
    for item in items:
        rest = items[items != item]
        if not problem.fault(rest):
            with np.errstate(all="ignore"):
                without = _refine(problem, problem.linear(rest), rest)
                out[item] = problem.metres(without)[item]
    return out


def _agreeing(problem: Problem, threshold: float) -> Items:
    """The largest set within `threshold` of one homography: through four of its items first, then refined to all."""
    everything = np.arange(len(problem.marks))
    best: tuple[int, float, Items] | None = None
    for four in _fours(len(everything)):
        if problem.fault(four):
            continue
        off = np.linalg.norm(problem.residual(problem.linear(four), everything), axis=1)
        near = everything[off <= threshold]
        score = (len(near), -float(np.sum(off[near] ** 2)))
        if len(near) >= 4 and (best is None or score > best[:2]):
            best = (*score, near)
    if best is None:
        raise InputError(f"no four {problem.noun}s agree within {threshold:g}; check their order and units")
    items, H = best[2], problem.linear(best[2])
    for _ in range(5):
        H = _refine(problem, H, items)
        near = everything[np.linalg.norm(problem.residual(H, everything), axis=1) <= threshold]
        if len(near) < 4 or np.array_equal(near, items) or problem.fault(near):
            break
        items = near
    return items


def _fours(count: int) -> Array:
    """All sets of four of `count` items, or a fixed sample of them."""
    if math.comb(count, 4) <= MAX_SUBSETS:
        return np.array(list(itertools.combinations(range(count), 4)))
    rng = np.random.default_rng(0)
    return np.array([np.sort(rng.choice(count, 4, replace=False)) for _ in range(MAX_SUBSETS)])


def points_fault(image: Array, world: Array, items: Items) -> str:
    """Why these scaled points (n, 2) cannot carry a homography, or ''; `items` (n,) name their rows, from 0."""
    for points, where in ((image, "in the image"), (world, "on the ground")):
        if twins := cKDTree(points).query_pairs(1e-6):
            a, b = min(twins)
            return f"points {items[a] + 1} and {items[b] + 1} are the same point {where}"
        offset = points - points.mean(axis=0)
        scatter = offset.T @ offset
        if _width(scatter) < COLLINEAR:
            return f"the points lie on one line {where}; spread them over the ground"
        # the scatter without point k, about the mean without it
        n = len(points)
        without = scatter - n / (n - 1) * offset[:, :, None] * offset[:, None, :]
        if np.any(_width(without) < COLLINEAR / 4):
            return f"all points but one lie on one line {where}; a homography needs four, no three of them on a line"
    return ""


def _width(scatter: Array) -> Array:
    """Extent across the longest direction as a share of the length, from scatter matrices (..., 2, 2)."""
    values = np.linalg.eigvalsh(scatter)
    return np.asarray(np.sqrt(np.clip(values[..., 0], 0, None) / np.maximum(values[..., -1], 1e-300)))
