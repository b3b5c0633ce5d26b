"""The way a vehicle takes, in the left camera's frame: a curve by arc length, with the road's frame along it.

The Frenet frame is undefined on straights and flips at inflections: here the frame is tangent, road normal and their
cross product.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from visfuse_cli.maths.planes import in_right, projected
from visfuse_cli.records import Array, StereoRig

UP = np.array([0.0, -1.0, 0.0])  # image axes: v runs down
DRAWN_PX = 0.1  # how well the lines of a path are drawn
SLOPE = 0.3  # of a road, in the left camera's axes
FINE = 400
FARTHEST = 1e4  # m
SPARE = 4  # points beyond a bend's degree, so that it is told by more than their noise


class Way:
    """A curve through points (n, 3) m, by arc length s (m) from the first one; it goes on straight at both ends."""

    def __init__(self, points: Array) -> None:
        step = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if len(points) < 2 or not np.isfinite(points).all() or np.any(step < 1e-6):
            raise ValueError("a path needs two different points or more")
        self.s = np.concatenate([[0.0], np.cumsum(step)])
        self._curve = _spline(self.s, points) if len(points) > 2 else None
        self._points = points
        if self._curve is not None:  # chords are shorter than the arc: measure the spline, and lay knots evenly on it
            fine = np.linspace(0, self.s[-1], 100 * len(points))
            length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self._curve(fine), axis=0), axis=1))])
            self.s = np.linspace(0, length[-1], 6 * len(points))
            self._curve = _spline(self.s, self._curve(np.interp(self.s, length, fine)))

    @property
    def length(self) -> float:
        """m."""
        return float(self.s[-1])

    def frame(self, s: Array) -> tuple[Array, Array]:
        """Points (..., 3) m and axes (..., 3, 3) at s (...): columns tangent, to the right of it, up."""
        inside = np.clip(s, 0.0, self.length)
        beyond = np.asarray(s - inside)[..., None]
        if self._curve is None:
            along = (self._points[1] - self._points[0]) / self.length
            tangent = np.broadcast_to(along, (*np.shape(s), 3))
            point = self._points[0] + inside[..., None] * along
        else:
            point, tangent = self._curve(inside), self._curve(inside, 1)
            tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
        steep = np.abs(tangent @ UP)[..., None] > 0.95  # straight up or down: the camera's axis stands for the normal
        right = np.cross(tangent, np.where(steep, [0.0, 0.0, -1.0], UP))
        right = right / np.linalg.norm(right, axis=-1, keepdims=True)
        up = np.cross(right, tangent)
        return np.asarray(point + beyond * tangent), np.stack([tangent, right, up], axis=-1)

    def nearest(self, point: Array) -> float:
        """The s whose point is nearest to a point (3,), also beyond the ends."""
        s = np.linspace(-self.length, 2 * self.length, 3001)
        for _ in range(3):
            off = np.linalg.norm(self.frame(s)[0] - point, axis=1)
            best, step = s[int(np.argmin(off))], s[1] - s[0]
            s = np.linspace(best - step, best + step, 201)
        return float(best)

    def reversed(self) -> Way:
        """The same way taken from its end."""
        return Way(self._points[::-1].copy())


def _spline(s: Array, points: Array) -> CubicSpline:
    """A cubic spline; its ends are as bent as what lies beside them, where that can be told."""
    return CubicSpline(s, points, bc_type="not-a-knot" if len(points) > 3 else "natural")


def straight(rig: StereoRig, left: Array, right: Array) -> Way:
    """The way whose images are the lines through left (2, 2) and right (2, 2) px. Zhu 2012, eqs. 19-21.

    Raises ValueError where the two lines' planes nearly coincide.
    """
    n1 = _plane_of(rig.left.K, left)
    n2 = rig.R.T @ _plane_of(rig.right.K, right)  # in the left camera's axes, through the right centre
    k = np.cross(n1, n2)
    if np.linalg.norm(k) < 2e-4:
        raise ValueError("both image lines show one plane: the path's depth cannot be told")
    k /= np.linalg.norm(k)
    centre = -rig.R.T @ rig.T
    # The point of the line that is nearest to the left camera, and from there to where the image line's ends look.
    point = np.linalg.solve(np.stack([n1, n2, k]), [0.0, float(n2 @ centre), 0.0])
    rays = np.column_stack([left, np.ones(2)]) @ np.linalg.inv(rig.left.K).T
    ends = []
    for ray in rays:
        A = np.column_stack([ray, -k])
        depth, along = np.linalg.lstsq(A, point, rcond=None)[0]
        if depth > 0:
            ends.append(point + along * k)
    if len(ends) < 2 or np.linalg.norm(ends[1] - ends[0]) < 1e-3:
        raise ValueError("the path lies behind the cameras")
    return Way(np.stack(ends))


def _plane_of(K: Array, line: Array) -> Array:
    """The normal (3,) of the plane through the camera and an image line (2, 2) px."""
    a, b = np.column_stack([line, np.ones(2)]) @ np.linalg.inv(K).T
    n = np.cross(a, b)
    return np.asarray(n / np.linalg.norm(n))


def curved(rig: StereoRig, left: Array, right: Array) -> Way:
    """The way whose images are polylines left (n, 2) and right (m, 2) px, which need not correspond.

    It lies on a road that is flat: the road is sought on which both polylines are one curve, which is smoother there
    than in the pictures. Raises ValueError where no such road lies before the cameras.
    """
    away = np.column_stack([left, np.ones(len(left))]) @ np.linalg.inv(rig.left.K).T
    rays = {"left": away, "right": np.column_stack([right, np.ones(len(right))]) @ np.linalg.inv(rig.right.K).T @ rig.R}
    centres = {"left": np.zeros(3), "right": -rig.R.T @ rig.T}

    def on_road(view: str, road: Array) -> Array:
        # height below the camera, slope to the right and ahead: Y = h + a X + b Z
        normal = np.array([-road[1], 1.0, -road[2]])
        facing = rays[view] @ normal
        depth = (road[0] - centres[view] @ normal) / np.where(np.abs(facing) > 1e-6, facing, 1e-6)
        return np.asarray(centres[view] + depth[:, None] * rays[view])

    def off(road: Array) -> Array:
        here, there = on_road("left", road), on_road("right", road)
        seen = projected(rig.right.K, in_right(rig, _resampled(here)))
        seen_back = projected(rig.left.K, _resampled(there))
        distance = [
            _to_polyline(right, np.nan_to_num(seen, nan=1e4)),
            _to_polyline(left, np.nan_to_num(seen_back, nan=1e4)),
        ]
        return np.concatenate([np.clip(each, -1e3, 1e3) / DRAWN_PX for each in distance] + [road[1:] / SLOPE])

    best = None
    for depth in (8.0, 15.0, 30.0, 60.0, 120.0):
        found = least_squares(off, np.array([float(np.mean(away[:, 1])) * depth, 0.0, 0.0]), max_nfev=100)
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    points = on_road("left", best.x)
    if np.sqrt(np.mean(off(best.x)[:-2] ** 2)) * DRAWN_PX > 3.0 or np.any(
        (points[:, 2] < 0.1) | (points[:, 2] > FARTHEST)
    ):
        raise ValueError("the two images of the path do not fit one curve on a road before both cameras")
    return Way(points)


def _resampled(line: Array) -> Array:
    """Many points (FINE, c) evenly along a smooth curve through points (n, c)."""
    step = np.concatenate([[0.0], np.cumsum(np.maximum(np.linalg.norm(np.diff(line, axis=0), axis=1), 1e-9))])
    fine = np.linspace(0, step[-1], FINE)
    if len(line) > 2:
        return np.asarray(_spline(step, line)(fine))
    return np.stack([np.interp(fine, step, line[:, c]) for c in range(line.shape[1])], axis=1)


def _to_polyline(points: Array, line: Array) -> Array:
    """Signed distance (n,) px of points (n, 2) from a dense polyline (m, 2), which goes on straight at its ends."""
    k = np.argmin(np.sum((points[:, None] - line[None]) ** 2, axis=-1), axis=1)
    k = np.clip(k, 1, len(line) - 2)
    tangent = line[k + 1] - line[k - 1]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    away = points - line[k]
    return np.asarray(tangent[:, 0] * away[:, 1] - tangent[:, 1] * away[:, 0])


def through(points: Array, sigma: Array, roughness: float) -> Way:
    """The smooth way past noisy points (n, 3) m in order of time, deviations sigma (n,); straight if that does."""
    weight = 1 / sigma**2
    middle = (weight @ points) / weight.sum()
    _, _, axes = np.linalg.svd((points - middle) * np.sqrt(weight)[:, None], full_matrices=False)
    along = (points - middle) @ axes[0]
    if along[-1] < along[0]:
        along, axes = -along, -axes
    degree = 1
    for trial in (2, 3):
        if len(points) >= trial + SPARE:
            fit = np.polynomial.polynomial.polyfit(along, points, trial, w=np.sqrt(weight))
            line = np.polynomial.polynomial.polyfit(along, points, degree, w=np.sqrt(weight))
            gain = [
                float(np.sum(weight[:, None] * (points - np.polynomial.polynomial.polyval(along, c).T) ** 2))
                for c in (line, fit)
            ]
            noise = max(1.0, gain[1] / (3 * (len(points) - trial - 1)))  # what the points themselves show of it
            if gain[0] - gain[1] > roughness * noise * (trial - degree):
                degree = trial
    fit = np.polynomial.polynomial.polyfit(along, points, degree, w=np.sqrt(weight))
    reach = np.linspace(
        along.min() - 0.02 * np.ptp(along), along.max() + 0.02 * np.ptp(along), 2 if degree == 1 else 13
    )
    return Way(np.asarray(np.polynomial.polynomial.polyval(reach, fit).T, dtype=float))
