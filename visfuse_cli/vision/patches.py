"""A flat patch in pictures: sampled on a grid, aligned to sub-pixel, compared part by part for many poses at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, Image

Grey = NDArray[np.float32]
PARTS = 10  # of a patch, in two rows
CELLS = 4  # of each part, each way
LEVELS = 5
ROUNDS = 20
FEWEST, MOST = 10, 72  # samples along a side of a patch that is aligned
HUBER = 2.5
CHUNK = 64  # poses that are sampled at once
LONGEST = 30000  # rows of a picture that remap makes
EDGE = 2.0  # px within the picture, so that a patch can be shifted
VISIBLE = 0.6  # share of a patch that must be in the picture
SEARCH = 0.8  # of its size: how far around the prediction a lost target is looked for
PLAIN = 4.0  # grey levels: differences of neighbouring samples of a patch without edges are smaller
AROUND, AROUND_PX = 0.12, 3.0  # of its side, and px: how far its template then reaches beyond it
FREE, KEPT = np.eye(4), np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1]])  # of a patch's stretch, by its freedom
RIM_PX = 0.5  # px inside of a quad at which its patch begins: beyond its edge lies something else


def pyramid(image: Image) -> list[Grey]:
    """The grey picture and its halves; pixel u of level k lies at u 2^k of the first."""
    levels: list[Grey] = [np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.float32)]
    for _ in range(LEVELS - 1):
        if min(levels[-1].shape) < 40:
            break
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.float32))
    return levels


def sampled(levels: list[Grey], points: Array, spacing: float) -> Grey:
    """Grey values (...) at pixels (..., 2), from the level whose pixels are as wide as `spacing` (px); 0 outside."""
    level = _level(levels, spacing)
    at = (points / 2**level).astype(np.float32)
    flat = np.ascontiguousarray(at.reshape(-1, 2))
    # One row of the picture that is made for each pose.
    columns = points.shape[-2] if points.ndim > 2 else len(flat)
    maps = np.nan_to_num(flat, nan=-1e6).reshape(-1, columns, 2)
    pieces = np.array_split(maps, -(-len(maps) // LONGEST))
    out = [cv2.remap(levels[level], piece, None, cv2.INTER_LINEAR) for piece in pieces]
    return np.concatenate(out).reshape(points.shape[:-1])


def _level(levels: list[Grey], spacing: float) -> int:
    """The level whose pixels are as wide as `spacing` (px)."""
    return int(np.clip(np.floor(np.log2(max(spacing, 1.0)) + 0.3), 0, len(levels) - 1)) if np.isfinite(spacing) else 0


def grid(count: tuple[int, int]) -> Array:
    """Middles (n, 2) of cells over the unit square, row by row."""
    u, v = np.meshgrid((np.arange(count[0]) + 0.5) / count[0], (np.arange(count[1]) + 0.5) / count[1])
    return np.column_stack([u.ravel(), v.ravel()])


def warped(quads: Array | Grey, unit: Array | Grey) -> Array:
    """Pixels (..., n, 2) of unit-square points (n, 2) in quads (..., 4, 2), clockwise from the top left: projective."""
    a, b, c, d = np.moveaxis(quads, -2, 0)
    p, q, r = b - c, d - c, a - b + c - d
    area = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    g = (r[..., 0] * q[..., 1] - r[..., 1] * q[..., 0]) / area
    h = (p[..., 0] * r[..., 1] - p[..., 1] * r[..., 0]) / area
    along, down = b - a + g[..., None] * b, d - a + h[..., None] * d
    # homogeneous, across and down in rows of their own: one product for all points of all quads
    M = np.stack([along, down, a], axis=-1)
    flat = np.concatenate([unit, np.ones_like(unit[:, :1])], axis=-1).T
    below = 1 + g[..., None] * unit[:, 0] + h[..., None] * unit[:, 1]
    return np.asarray(np.moveaxis((M @ flat) / below[..., None, :], -2, -1))


def side(quad: Array) -> tuple[float, float]:
    """Mean width and height (px) of a quad (4, 2)."""
    edge = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1)
    return float(edge[0] + edge[2]) / 2, float(edge[1] + edge[3]) / 2


def log_height(quad: Array) -> Array:
    """Log of the height (...) px of quads (..., 4, 2), which turning about the vertical does not change."""
    return np.asarray(
        np.log(np.linalg.norm((quad[..., 2:, :] - quad[..., :2, :][..., ::-1, :]).mean(axis=-2), axis=-1))
    )


def inside(quad: Array, size: tuple[int, int], margin: float = 1.0) -> bool:
    """Whether a quad (4, 2) lies in a picture of that size."""
    return bool(np.isfinite(quad).all() and np.all(quad > margin) and np.all(quad < np.array(size) - 1 - margin))


@dataclass(frozen=True, slots=True)
class Template:
    """A patch to be found again: grey values (n,) at points (n, 2) of the unit square."""

    unit: Array
    values: Array


def template(levels: list[Grey], quad: Array) -> Template:
    """The patch in a quad (4, 2), sampled about as finely as the picture shows it."""
    wide, high = side(quad)
    count = (int(np.clip(round(wide), FEWEST, MOST)), int(np.clip(round(high), FEWEST, MOST)))
    rim = RIM_PX / np.array([wide, high])
    unit = rim + (1 - 2 * rim) * grid(count)
    return Template(unit, sampled(levels, warped(quad, unit), _spacing(quad, count)).astype(float))


def holding(levels: list[Grey], quad: Array) -> Template:
    """The patch in a quad (4, 2), and what lies around it where a plain inside has no edges to hold on to."""
    inside = template(levels, quad)
    values = inside.values.reshape(_count(inside.unit)[::-1])
    edges = [float(np.sqrt(np.mean(np.diff(values, axis=axis) ** 2))) for axis in (1, 0)]
    if min(edges) >= PLAIN:
        return inside
    more = np.where(np.array(edges) < PLAIN, np.maximum(AROUND, AROUND_PX / np.array(side(quad))), 0.0)
    unit = -more + (1 + 2 * more) * grid(_count(inside.unit))
    return Template(unit, sampled(levels, warped(quad, unit), _spacing(quad, _count(unit))).astype(float))


def visible(sought: Template, quad: Array, size: tuple[int, int]) -> Template | None:
    """What of a template in a quad (4, 2) lies in a picture of that size; None where less than VISIBLE of it does."""
    if not np.isfinite(quad).all():
        return None
    at = warped(quad, sought.unit)
    shape = _count(sought.unit)[::-1]
    there = np.all((at > EDGE) & (at < np.array(size) - 1 - EDGE), axis=-1).reshape(shape)
    kept = np.outer(there.any(axis=1), there.any(axis=0)).ravel()
    if np.count_nonzero(kept) < VISIBLE * len(kept):
        return None
    return Template(sought.unit[kept], sought.values[kept])


def follow(levels: list[Grey], quad: Array, sought: Template, stretch: float, good: float) -> Alignment | None:
    """Find a template near a quad (4, 2), or around it where it is lost; None where it is not, or mostly out of view.

    The shift is from the quad that was given.
    """
    size = levels[0].shape[1], levels[0].shape[0]
    part = visible(sought, quad, size)
    if part is None:
        return None
    whole = len(part.values) == len(sought.values)
    found = align(levels, quad, part, stretch if whole else stretch / 10)  # a part tells little of the size
    if found is not None and found.correlation >= good and visible(sought, found.quad(quad), size) is not None:
        return found
    moved = searched(levels[0], quad, sought, SEARCH, good) if whole else None
    found = None if moved is None else align(levels, moved, sought, stretch)
    if moved is None or found is None or found.correlation < good:
        return None
    return replace(found, shift=found.shift + (moved - quad).mean(axis=0))


def _spacing(quad: Array, count: tuple[float, float]) -> float:
    wide, high = side(quad)
    return float(np.sqrt(wide / count[0] * high / count[1]))


def _count(unit: Array) -> tuple[int, int]:
    across = int(np.sum(unit[:, 1] == unit[0, 1]))
    return across, len(unit) // across


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where a patch was found: shift (2,) px and log stretch (2,) of the quad about its middle, their covariance (4, 4)
    and the correlation with the template.
    """

    shift: Array
    stretch: Array
    cov: Array
    correlation: float

    def quad(self, quad: Array) -> Array:
        """The quad (4, 2) as it was found."""
        middle = quad.mean(axis=0)
        return np.asarray(middle + self.shift + np.exp(self.stretch) * (quad - middle))


def align(
    levels: list[Grey], quad: Array, sought: Template, stretch_sigma: float = np.inf, shape: Array = FREE
) -> Alignment | None:
    """Find a template near a quad (4, 2) by Gauss-Newton on grey values, gain and offset free; None where it is lost.

    The log stretch is believed to be zero but for `stretch_sigma`; with `shape` KEPT it is the same across and down.
    """
    points = warped(quad, sought.unit)
    middle = quad.mean(axis=0)
    spacing = _spacing(quad, _count(sought.unit))
    p, free = np.zeros(4), shape.shape[1]
    reach = max(3.0, 0.25 * min(side(quad)))
    A, weight, left = np.zeros((free, free)), np.ones(len(points)), np.zeros(len(points))
    now, h = sought.values, max(0.5, spacing / 2)
    gain, noise2 = 1.0, 1.0
    for _ in range(ROUNDS):
        away = points - middle
        at = middle + p[:2] + np.exp(p[2:]) * away
        around = np.stack([at, at + [h, 0], at - [h, 0], at + [0, h], at - [0, h]])
        values = sampled(levels, around, spacing).astype(float)
        now = values[0]
        spread = float(now.std())
        if spread < 1e-3 or float(sought.values.std()) < 1e-3:
            return None
        gx, gy = (values[1] - values[2]) / (2 * h), (values[3] - values[4]) / (2 * h)
        scaled = np.exp(p[2:]) * away
        J = np.column_stack([gx, gy, gx * scaled[:, 0], gy * scaled[:, 1]])
        X = np.column_stack([J @ shape, now, np.ones(len(now))])
        # template = a I(x(p)) + b: linear in gain and offset, so they are solved with the step
        W = weight[:, None] * X
        normal, known = W.T @ X + 1e-9 * np.eye(free + 2), W.T @ sought.values
        pull = noise2 / (gain**2 * stretch_sigma**2)  # of the prior, on gain times stretch
        normal[:free, :free] += pull * shape[2:].T @ shape[2:]
        known[:free] -= pull * gain * shape[2:].T @ p[2:]
        solution = np.linalg.lstsq(normal, known, rcond=None)[0]
        gain = float(solution[-2])
        if gain <= 0.05:
            return None
        left = sought.values - X @ solution
        scale = 1.4826 * float(np.median(np.abs(left))) + 1e-6
        noise2 = scale**2
        weight = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(left), 1e-9))
        step = shape @ solution[:free] / gain
        p = p + np.clip(step, -2 * spacing, 2 * spacing) * [1, 1, 0.5, 0.5]
        if np.linalg.norm(p[:2]) > reach or np.any(np.abs(p[2:]) > 0.5):
            return None
        A = gain**2 * (W[:, :free].T @ X[:, :free])
        if np.linalg.norm(step[:2]) < 0.002 and np.abs(step[2:]).max() < 2e-5:
            break
    sigma2 = float(np.sum(weight * left**2) / max(np.sum(weight) - free - 2, 1))
    correlation = float(np.corrcoef(now, sought.values)[0, 1])
    cov = np.asarray(shape @ np.linalg.pinv(A) @ shape.T, dtype=float) * sigma2
    return Alignment(p[:2], p[2:], cov, correlation)


def searched(level: Grey, quad: Array, sought: Template, reach: float, good: float) -> Array | None:
    """The quad (4, 2) moved to where the template fits best around it, to whole pixels; None where nowhere well.

    `reach` is a share of its sides. Jia 2008, eq. 3.
    """
    wide, high = side(quad)
    count = (max(int(wide), 8), max(int(high), 8))
    away = reach * np.array([wide, high])
    low = np.maximum(np.floor(quad.min(axis=0) - away), 0).astype(int)
    top = np.minimum(np.ceil(quad.max(axis=0) + away), [level.shape[1], level.shape[0]]).astype(int)
    picture = sought.values.reshape(_count(sought.unit)[::-1]).astype(np.float32)
    share = np.clip(np.ptp(sought.unit, axis=0) + 1 / np.array(_count(sought.unit)), 1.0, None)  # it may reach beyond
    count = (int(count[0] * share[0]), int(count[1] * share[1]))
    if np.any(top - low < np.array(count) + 2):
        return None
    wanted = cv2.resize(picture, count, interpolation=cv2.INTER_AREA)
    window = np.ascontiguousarray(level[low[1] : top[1], low[0] : top[0]])
    _, best, _, at = cv2.minMaxLoc(cv2.matchTemplate(window, wanted, cv2.TM_CCOEFF_NORMED))
    if best < good:
        return None
    return np.asarray(quad + low + np.array(at) + (np.array(count) - 1) / 2 - quad.mean(axis=0))


def part_cells(parts: int) -> Array:
    """Middles (16 parts, 2) over the unit square of the 4 x 4 cells of each part; an odd part goes to the upper row."""
    rows = (parts - parts // 2, parts // 2)
    upper, lower = (grid((across * CELLS, CELLS)) * [1.0, 0.5] for across in rows)
    return np.concatenate([upper, lower + [0.0, 0.5]])


def part_level(levels: list[Grey], quads: Array, parts: int) -> int:
    """The level of the pyramid that suits the cells of quads (P, 4, 2)."""
    count = (parts / 2 * CELLS, 2 * CELLS)
    some = [_spacing(quad, count) for quad in quads[:: len(quads) // 9 + 1]]
    return _level(levels, float(np.median(some)))


def part_values(levels: list[Grey], quads: Array, parts: int = PARTS, level: int | None = None) -> Grey:
    """Cell values (P, 16 parts) of the parts of quads (P, 4, 2), 4 x 4 cells each, normalised in mean and contrast.

    In orthonormal form the distance of a part's 16 Haar-like values is that of its 16 cells. Zhu 2012, eq. 13.
    """
    level = part_level(levels, quads, parts) if level is None else level
    unit = part_cells(parts).astype(np.float32)
    usable = np.nan_to_num(quads / 2**level, nan=-1e6).astype(np.float32)
    at = warped(usable, unit)
    across, down = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    values = cv2.remap(levels[level], across, down, cv2.INTER_LINEAR)
    values -= values.mean(axis=-1, keepdims=True)
    spread = np.sqrt(np.einsum("pc,pc->p", values, values) / len(unit))
    return np.asarray(values / np.maximum(spread, 1e-3)[:, None], np.float32)


def observed(
    views: tuple[list[Grey], list[Grey]], quads: tuple[Array, Array], reference: Grey, parts: int
) -> tuple[Array, Array]:
    """Distance (P,) of both views' parts in quads (P, 4, 2) from a reference, and correlation (P,) across the views."""
    levels = [part_level(view, quad, parts) for view, quad in zip(views, quads, strict=True)]
    distance, across = np.empty(len(quads[0])), np.empty(len(quads[0]))
    for k in range(0, len(distance), CHUNK):  # small buffers that stay in the cache, however many poses there are
        some = slice(k, k + CHUNK)
        left, right = (part_values(views[i], quads[i][some], parts, levels[i]) for i in (0, 1))
        distance[some] = part_distance(left, reference) + part_distance(right, reference)
        across[some] = correlations(left, right)
    return distance, across


def part_distance(values: Grey, reference: Grey) -> Array:
    """Mean distance (P,) of the parts from a reference (cells,). Zhu 2012, eq. 13."""
    off = values - reference
    return np.asarray(np.einsum("pc,pc->p", off, off) / off.shape[-1], dtype=float)


def correlations(left: Grey, right: Grey) -> Array:
    """Normalised cross-correlation (P,) of what both views show. Zhu 2012, eqs. 17-18."""
    return np.asarray((left * right).mean(axis=-1), dtype=float)
