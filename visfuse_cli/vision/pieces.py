"""Pieces of a patch, each found again on its own: what is not flat moves piece by piece, and what turns loses some."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from visfuse_cli.records import Array
from visfuse_cli.vision.patches import Grey, side

SAMPLES = 14  # along a side of a piece
SMALLEST, MOST = 11.0, (6, 4)  # px: a piece's side at its first sight; pieces across and down
ROUNDS = 10
REACH = 0.35  # of a piece's half side, that it may be off where it is expected
SURE = 0.5  # px, how well it is expected there, beside REACH
ALIKE = 0.75  # correlation from which on a piece is recognised
PATIENCE = 3  # looks in a row without it, after which a piece is given up
FEWEST = 3  # pieces that carry a quad
STIFF_PX = 15.0  # noise of pieces by the deviation of the patch's size from what is expected
FLAT = 2.0  # grey levels: deviation below which a piece has nothing to be recognised by
_AXIS = (np.arange(SAMPLES) + 0.5) / SAMPLES * 2 - 1
UNIT = np.stack(np.meshgrid(_AXIS, _AXIS), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class Seen:
    """Pieces seen at one instant: their numbers (P,), left and right pixels (P, 2), the left one's covariance (P, 2, 2)
    and that of what the right one adds.
    """

    pieces: Array
    left: Array
    right: Array
    left_cov: Array
    across_cov: Array


@dataclass(slots=True)
class _Piece:
    number: int
    half: Array  # (2,) half sides, in those of the patch
    values: Array  # (n,) grey values at its first sight
    unit: dict[str, Array]  # (2,) of the patch in each view, where it was seen last
    seen: bool = False
    missed: int = 0


@dataclass(slots=True)
class Pieces:
    """The pieces of one patch that are followed."""

    followed: list[_Piece] = field(default_factory=list)
    count: int = 0

    def look(self, views: dict[str, list[Grey]], quads: dict[str, Array]) -> tuple[Seen, dict[str, Array]]:
        """Find the pieces again near quads (4, 2) px by view, and begin new ones where there is room.

        Returns them with the quads as the pieces carry them: a patch that is taken anew now and then would creep.
        """
        self._begin(views["left"], quads["left"])
        pieces = self.followed
        if not pieces:
            return Seen(*(np.zeros((0, *shape)) for shape in ((), (2,), (2,), (2, 2), (2, 2)))), quads
        share = np.stack([piece.half for piece in pieces])
        half = {view: share[..., None] * _sides(quad) for view, quad in quads.items()}
        expected = {view: placed(quad, np.stack([p.unit[view] for p in pieces])) for view, quad in quads.items()}
        left, left_cov, here = aligned(
            views["left"], expected["left"], half["left"], np.stack([piece.values for piece in pieces])
        )
        now = _sampled(views["left"], left, half["left"])
        right, across_cov, there = aligned(views["right"], expected["right"], half["right"], now)
        found = (here > ALIKE) & (there > ALIKE)
        known = found & np.array([piece.seen for piece in pieces])
        places = {"left": left, "right": right}
        if np.count_nonzero(known) >= FEWEST:
            quads = {v: carried(quads[v], expected[v][known], places[v][known]) for v in quads}
        unit = {view: _unit(quad, places[view]) for view, quad in quads.items()}
        for k, piece in enumerate(pieces):
            piece.missed = 0 if found[k] else piece.missed + 1
            if found[k]:
                piece.seen, piece.unit = True, {view: unit[view][k] for view in quads}
        self.followed = [piece for piece in pieces if piece.missed < PATIENCE]
        numbers = np.array([piece.number for piece in pieces])
        return Seen(numbers[found], left[found], right[found], left_cov[found], across_cov[found]), quads

    def moved(self, before: dict[str, Array], after: dict[str, Array]) -> None:
        """Keep the pieces where they are while the quads (4, 2) by view move away under them."""
        for piece in self.followed:
            for view, quad in after.items():
                piece.unit[view] = _unit(quad, placed(before[view], piece.unit[view][None]))[0]
            piece.half = piece.half * np.divide(side(before["left"]), side(after["left"]))

    def _begin(self, levels: list[Grey], quad: Array) -> None:
        """New pieces on the cells of a regular grid over the quad that hold none."""
        wide, high = side(quad)
        count = [int(np.clip(length // SMALLEST, 1, most)) for length, most in zip((wide, high), MOST, strict=True)]
        taken = {tuple(np.floor(piece.unit["left"] * count).astype(int)) for piece in self.followed}
        free = [(i, j) for j in range(count[1]) for i in range(count[0]) if (i, j) not in taken]
        if not free:
            return
        unit = (np.array(free) + 0.5) / count
        half = 1 / np.array(count) / 2
        values = _sampled(levels, placed(quad, unit), np.tile(half[:, None] * _sides(quad), (len(free), 1, 1)))
        for k in np.flatnonzero(values.std(axis=1) > FLAT):
            self.followed.append(_Piece(self.count, half, values[k], {"left": unit[k], "right": unit[k]}))
            self.count += 1


def _sides(quad: Array) -> Array:
    """Mean edges (2, 2) px of a quad (4, 2): across, down."""
    return np.stack([quad[1] - quad[0] + quad[2] - quad[3], quad[3] - quad[0] + quad[2] - quad[1]]) / 2


def placed(quad: Array, unit: Array) -> Array:
    """Pixels (P, 2) of places (P, 2) in the unit square of a quad (4, 2), to first order."""
    return np.asarray(quad.mean(axis=0) + (unit - 0.5) @ _sides(quad))


def _unit(quad: Array, pixels: Array) -> Array:
    """Places (P, 2) in the unit square of a quad (4, 2) of pixels (P, 2), to first order."""
    return np.asarray((pixels - quad.mean(axis=0)) @ np.linalg.inv(_sides(quad)) + 0.5)


def carried(quad: Array, expected: Array, found: Array) -> Array:
    """A quad (4, 2) moved and scaled as pieces were from where they were expected (P, 2) to where they are (P, 2)."""
    middle = quad.mean(axis=0)
    away, moved = expected - middle, found - expected
    shift, stretch = np.median(moved, axis=0), 0.0
    for _ in range(3):
        left = np.linalg.norm(moved - shift - stretch * away, axis=1)
        near = left <= 2.0 * np.median(left) + 0.05
        apart = away[near] - away[near].mean(axis=0)
        # a few pieces close together tell little of the size, which is believed to be nearly right
        stretch = float(np.sum(apart * moved[near]) / (np.sum(apart**2) + STIFF_PX**2))
        shift = moved[near].mean(axis=0) - stretch * away[near].mean(axis=0)
    return np.asarray(middle + shift + np.exp(np.clip(stretch, -0.1, 0.1)) * (quad - middle))


def _lengths(half: Array) -> Array:
    """Lengths (P, 2) px of half sides (P, 2, 2) px."""
    return np.linalg.norm(half, axis=-1)


def _sampled(levels: list[Grey], middle: Array, half: Array) -> Array:
    """Grey values (..., P, n) of pieces about (..., P, 2) px of half sides (P, 2, 2) px: across, down."""
    spacing = float(np.median(np.sqrt(np.prod(_lengths(half), axis=-1)))) * 2 / SAMPLES
    level = int(np.clip(np.floor(np.log2(max(spacing, 1.0)) + 0.3), 0, len(levels) - 1))
    at = (middle[..., None, :] + UNIT @ half) / 2**level
    maps = np.ascontiguousarray(at.reshape(-1, SAMPLES * SAMPLES, 2), np.float32)
    values = cv2.remap(levels[level], maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(at.shape[:-1]).astype(float)


def aligned(levels: list[Grey], middle: Array, half: Array, values: Array) -> tuple[Array, Array, Array]:
    """Where pieces (P, n) lie near (P, 2) px: places (P, 2), covariances (P, 2, 2), correlations (P,), 0 where lost.

    `half` (P, 2, 2) px: half sides there. Gauss-Newton on grey values, all pieces at once, gain and offset free.
    """
    count = len(middle)
    long = _lengths(half)
    h = np.maximum(long / SAMPLES, 0.5)
    reach = np.maximum(REACH * long.min(axis=1), 1.0)
    shift = np.zeros((count, 2))
    target = values - values.mean(axis=1, keepdims=True)
    steps = np.stack([np.zeros_like(h), h * [1, 0], -h * [1, 0], h * [0, 1], -h * [0, 1]])
    cov, correlation = np.tile(np.eye(2), (count, 1, 1)), np.zeros(count)
    pull = np.eye(2) / (SURE + reach[:, None, None]) ** 2
    noise = np.full(count, 25.0)
    for _ in range(ROUNDS):
        around = _sampled(levels, middle + shift + steps, half)
        now = around[0] - around[0].mean(axis=1, keepdims=True)
        slope = np.stack([around[1] - around[2], around[3] - around[4]], axis=-1) / (2 * h[:, None, :])
        slope = slope - slope.mean(axis=1, keepdims=True)
        power = np.sum(now**2, axis=1) + 1e-9
        gain = np.sum(now * target, axis=1) / power
        left = target - gain[:, None] * now
        noise = np.sum(left**2, axis=1) / (SAMPLES * SAMPLES - 4) + 0.25
        J = gain[:, None, None] * slope
        information = np.swapaxes(J, 1, 2) @ J / noise[:, None, None]
        known = np.einsum("pni,pn->pi", J, left) / noise[:, None] - np.einsum("pij,pj->pi", pull, shift)
        cov = np.linalg.inv(information + pull)
        step = np.einsum("pij,pj->pi", cov, known)
        shift = shift + np.clip(step, -h * 2, h * 2)
        correlation = np.sum(now * target, axis=1) / np.sqrt(power * (np.sum(target**2, axis=1) + 1e-9))
        if np.abs(step).max() < 0.003:
            break
    # Samples finer than the picture's pixels do not add to each other.
    finer = np.maximum(1.0, np.prod(SAMPLES / (2 * long), axis=1))
    lost = (np.linalg.norm(shift, axis=1) > reach) | (gain <= 0.05) | (np.sqrt(cov[:, 0, 0] + cov[:, 1, 1]) > SURE)
    return middle + shift, cov * finer[:, None, None], np.where(lost, 0.0, correlation)
