"""Straight edges of a picture, and roughly drawn lines moved onto them (Bradshaw 1997, sec. 3.2.1)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, Image

TURN = np.radians(25)  # change of direction at which a chain of edge pixels is split
ARM = 5  # px either side over which a direction is measured
SHORTEST = 12  # px: shorter pieces are no lines
SAME_DIRECTION = np.radians(8)  # a drawn line this far from an edge's direction is not meant for it


def trace(image: Image) -> list[Array]:
    """Straight pieces of the picture's edges as chains of pixels (k, 2): Canny, linked, split at high curvature."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    high = max(20.0, 1.2 * float(np.percentile(np.hypot(*_gradient(smooth)), 95)))
    edges = cv2.Canny(smooth, high / 2, high)
    chains, _ = cv2.findContours(edges, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return [piece for chain in chains for piece in _split(chain.reshape(-1, 2).astype(float))]


def _gradient(grey: Image) -> tuple[Array, Array]:
    data = grey.astype(np.float64)
    return np.asarray(cv2.Sobel(data, cv2.CV_64F, 1, 0)), np.asarray(cv2.Sobel(data, cv2.CV_64F, 0, 1))


def _split(chain: Array) -> list[Array]:
    """Cut a chain (n, 2) where it turns."""
    if len(chain) < SHORTEST:
        return []
    before = chain - np.roll(chain, ARM, axis=0)
    after = np.roll(chain, -ARM, axis=0) - chain
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turn = np.abs(np.arctan2(cross, np.sum(before * after, axis=1)))
    pieces = np.split(chain, np.flatnonzero(turn > TURN))
    return [piece for piece in pieces if len(piece) >= SHORTEST]


def total_least_squares(points: Array, weights: Array | None = None) -> tuple[Array, Array]:
    """A point (2,) on the line nearest to points (n, 2) at right angles, and its unit direction (2,)."""
    w = np.ones(len(points)) if weights is None else weights
    centre = np.average(points, axis=0, weights=w)
    offset = points - centre
    _, vectors = np.linalg.eigh((offset * w[:, None]).T @ offset)
    return centre, vectors[:, -1]


def snap(image: Image, lines: Array, radius_px: float) -> tuple[Array, NDArray[np.bool_]]:
    """Move drawn lines (N, 4) px onto the edge under each; those without an edge within `radius_px` stay, marked False.

    Of several edges, as the two of a painted line, the one nearest to the drawn line wins. Bradshaw 1997, sec. 3.2.1.
    """
    pieces = trace(image)
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    gx, gy = _gradient(cv2.GaussianBlur(grey, (0, 0), 0.6))
    snapped, found = lines.copy(), np.zeros(len(lines), dtype=bool)
    for k, line in enumerate(lines):
        edge = _edge_under(line, pieces, radius_px)
        if edge is not None:
            centre, direction = _refined(edge, gx, gy)
            ends = line.reshape(2, 2)
            snapped[k] = (centre + ((ends - centre) @ direction)[:, None] * direction).ravel()
            found[k] = True
    return snapped, found


def _edge_under(line: Array, pieces: list[Array], radius_px: float) -> Array | None:
    """Edge pixels (n, 2) of the straight edge nearest to a drawn line: all pieces that continue the best one."""
    start, end = line.reshape(2, 2)
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    across = np.array([-along[1], along[0]])
    meant: list[tuple[float, Array]] = []
    for piece in pieces:
        inside = piece[((piece - start) @ along > -2) & ((piece - start) @ along < length + 2)]
        if len(inside) < SHORTEST:
            continue
        off = (inside - start) @ across
        near = np.abs(off) <= radius_px
        _, direction = total_least_squares(inside)
        if near.mean() > 0.8 and abs(direction @ along) > np.cos(SAME_DIRECTION):
            meant.append((float(np.abs(np.mean(off))), inside))
    if not meant:
        return None
    best = min(meant, key=lambda item: item[0] - 0.02 * len(item[1]))[1]
    centre, direction = total_least_squares(best)
    normal = np.array([-direction[1], direction[0]])
    return np.concatenate([piece for _, piece in meant if np.abs((piece - centre) @ normal).mean() < 1.5])


def _refined(edge: Array, gx: Array, gy: Array) -> tuple[Array, Array]:
    """The edge to a fraction of a pixel: the gradient's centre of mass along the normal at each of its pixels."""
    centre, direction = total_least_squares(edge)
    reach = np.arange(-2.5, 2.51, 0.25)
    for _ in range(3):
        normal = np.array([-direction[1], direction[0]])
        at = centre + ((edge - centre) @ direction)[:, None] * direction
        samples = (at[:, None] + reach[:, None] * normal).astype(np.float32)
        slope = (
            cv2.remap(gx, samples, None, cv2.INTER_LINEAR) * normal[0]
            + cv2.remap(gy, samples, None, cv2.INTER_LINEAR) * normal[1]
        )
        # the other edge of a thin painted line slopes the other way, and has no say
        slope = np.maximum(slope * np.sign(np.median(slope[:, abs(reach) < 1])), 0)
        slope = np.clip(slope - 0.3 * slope.max(axis=1, keepdims=True), 0, None) ** 2
        weight = slope.sum(axis=1)
        offset = (slope @ reach) / np.maximum(weight, 1e-9)
        centre, direction = total_least_squares(at + offset[:, None] * normal, np.sqrt(weight) + 1e-9)
    return centre, direction
