"""A whole track at once: where the vehicle was along its way, and where on it each piece sits, given all sightings.

The vehicle is rigid and need not be flat: a piece keeps its place (3,) m along the way's tangent, to the right and up
from the front's middle. States (T, 4): arc length m, speed m/s, drift to the right and up m.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import in_right, triangulated
from visfuse_cli.records import Array, StereoRig

Index = NDArray[np.intp]
ALONG, SPEED, RIGHT, UP = range(4)
ROUNDS = 6  # of linearisation, weights and noise anew
FREEDOM = 2.0  # of Student's t: how often a piece is seen where it is not
FLOOR_PX, LEAST = 0.03, 0.05  # px, of every sighting; least square of the noise in units of the expected
SHY = 3.0  # sightings that the usual noise stands for in a piece's own
STEP = 0.01  # m, of the numerical derivative along the way
LOOSE = np.array([1e3, 80.0, 20.0, 20.0])  # of the first state
AROUND_S = 0.35  # s, over which drift across the way is told
REACH = 20.0  # m: of pieces across
ANCHOR_PX = 0.05  # how well the first quad's middle tells what point is tracked
SIGMAS = np.array([0.01, 0.03, 0.1, 0.25, 0.6, 1.5, 4.0])  # m/s a frame at 5 frames/s
USUAL, SPREAD = 0.06, 1.2  # of the deviation of speed, and of its logarithm, before anything is known
RELIEFS = np.array([0.01, 0.1, 0.5])  # of the front's height: how far from flat it is
MOST_SHARED = 8.0


@dataclass(frozen=True, slots=True)
class Sightings:
    """M sightings of F pieces at T instants: indices (M,), pixels (M, 2) without distortion, covariances (M, 2, 2)."""

    t: Array
    frame: Index
    piece: Index
    left: Array
    right: Array
    left_cov: Array
    across_cov: Array

    @property
    def pieces(self) -> int:
        """How many pieces there are."""
        return int(self.piece.max()) + 1


@dataclass(frozen=True, slots=True)
class Rules:
    """What is known beforehand: drift (m a frame at 5 frames/s), speed's deviation, the front's relief and height m.

    `anchor` (2,) px: the front's middle in the first left picture; `pace`: how much less than a car's speed this one's
    changes, because it is slower.
    """

    lateral: float
    vertical: float
    sigma_v: float
    relief: float
    height: float
    anchor: Array
    pace: float = 1.0


@dataclass(frozen=True, slots=True)
class Adjusted:
    """States (T, 4) with their joint covariance (4T, 4T), pieces (F, 3) m, and the noise in units of the expected."""

    states: Array
    cov: Array
    pieces: Array
    noise: float
    sigma_v: float
    relief: float


def adjust(rig: StereoRig, way: Way, seen: Sightings, rules: Rules, sigma_v: float | None, start: Array) -> Adjusted:
    """The most probable track from states `start` (T, 4); the speed's deviation from the track itself unless given."""
    T, F = len(seen.t), seen.pieces
    states, pieces = start.copy(), _first_pieces(rig, way, seen, start)
    rules = replace(rules, sigma_v=sigma_v or rules.sigma_v)
    noise2, shared, weight, own = 1.0, 1.0, np.ones(len(seen.frame)), np.ones(F)
    cov: Array = np.eye(4 * T + 3 * F)
    J, r = _rows(rig, way, seen, states, pieces)
    for number in range(ROUNDS):
        if number:
            weight, own = _trusted(seen, np.sum(r**2, axis=1) / noise2, own)
        data, pull = _summed(J, r, weight / (noise2 * shared), seen, T, F)
        if number >= 2:
            rules = _likeliest(rules, sigma_v, seen, states, pieces, data, pull)
        prior, prior_pull, _ = _prior(rules, seen, states, pieces)
        anchored, anchor_pull = _anchor(rig, way, states, rules, len(prior))
        cov = np.asarray(np.linalg.inv(data + prior + anchored), dtype=float)
        step = cov @ (pull + prior_pull + anchor_pull)
        states = states + step[: 4 * T].reshape(T, 4)
        pieces = pieces + step[4 * T :].reshape(F, 3)
        J, r = _rows(rig, way, seen, states, pieces)
        used = float(np.sum(cov * data.T))
        noise2 = float(np.sum(weight * np.sum(r**2, axis=1)) / max(4 * len(r) - used, 4.0))
        noise2 = max(noise2, LEAST)  # nothing is known better than that, and the sums stay well conditioned
        shared = _shared(seen, r / np.sqrt(noise2 * own[seen.piece, None]))
    cov = cov[: 4 * T, : 4 * T]
    return Adjusted(states, (cov + cov.T) / 2, pieces, float(np.sqrt(noise2 * shared)), rules.sigma_v, rules.relief)


def _trusted(seen: Sightings, q: Array, own: Array) -> tuple[Array, Array]:
    """Weights (M,) of sightings by their squared errors q (M,), and each piece's own noise (F,) in units of the usual.

    Student's t about each piece's noise, which is drawn to the usual one where a piece was seen a few times only.
    """
    t_weight = (FREEDOM + 4) / (FREEDOM + q / own[seen.piece])
    count = np.bincount(seen.piece)
    own = (np.bincount(seen.piece, t_weight * q) + 4 * SHY) / (4 * (count + SHY))
    return t_weight / own[seen.piece], own


def _first_pieces(rig: StereoRig, way: Way, seen: Sightings, states: Array) -> Array:
    """Where pieces (F, 3) m sit, roughly: the means of their triangulated places, near sightings first."""
    places = triangulated(rig, seen.left, seen.right)
    point, axes = way.frame(states[seen.frame, ALONG])
    point = point + states[seen.frame, RIGHT, None] * axes[..., 1] + states[seen.frame, UP, None] * axes[..., 2]
    off = np.einsum("mab,ma->mb", axes @ _turns(seen, states)[seen.frame], places - point)
    weight = 1 / np.maximum(places[:, 2], 0.1) ** 4
    total = np.bincount(seen.piece, weight)
    return np.stack([np.bincount(seen.piece, weight * off[:, c]) for c in range(3)], axis=1) / total[:, None]


def slopes(t: Array, drift: Array) -> Array:
    """Rates (T, c) m/s of drifts (T, c) m at times (T,), each over the time around it."""
    dt = t[None] - t[:, None]
    reach = max(AROUND_S, 1.01 * float(np.max(np.diff(t)))) if len(t) > 1 else AROUND_S
    near = (np.abs(dt) <= reach).astype(float)
    near /= near.sum(axis=1, keepdims=True)
    off = dt - (near * dt).sum(axis=1, keepdims=True)
    return np.asarray((near * off) @ drift / np.maximum((near * off**2).sum(axis=1), 1e-9)[:, None])


def _turns(seen: Sightings, states: Array) -> Array:
    """Rotations (T, 3, 3) of the vehicle against its way: it looks where it goes, also when it changes lanes."""
    aside = slopes(seen.t, states[:, [RIGHT]])[:, 0]
    angle = np.arctan2(aside * np.sign(states[:, SPEED]), np.maximum(np.abs(states[:, SPEED]), 0.1))
    cos, sin, zero = np.cos(angle), np.sin(angle), np.zeros(len(angle))
    return np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1], axis=-1).reshape(-1, 3, 3)


def _rows(rig: StereoRig, way: Way, seen: Sightings, states: Array, pieces: Array) -> tuple[Array, Array]:
    """Whitened residuals (M, 4) and their derivatives (M, 4, 6) by arc length, drift right and up, and the piece."""
    s, turn = states[seen.frame, ALONG], _turns(seen, states)[seen.frame]
    own = np.einsum("mab,mb->ma", turn, pieces[seen.piece])
    own[:, 1:] += states[seen.frame][:, [RIGHT, UP]]
    tried = []
    for move in (0.0, STEP, -STEP):
        point, axes = way.frame(s + move)
        tried.append(point + np.einsum("mab,mb->ma", axes, own))
    place, by_s = tried[0], (tried[1] - tried[2]) / (2 * STEP)
    axes = way.frame(s)[1]
    by = np.concatenate([by_s[..., None], axes[..., 1:], axes @ turn], axis=-1)  # d place / d state and piece (M, 3, 6)
    left, by_left = _seen_at(rig.left.K, place, by)
    right, by_right = _seen_at(rig.right.K, in_right(rig, place), rig.R @ by)
    r = np.stack([seen.left - left, (seen.right - seen.left) - (right - left)], axis=1)  # (M, 2, 2)
    J = np.stack([by_left, by_right - by_left], axis=1)  # (M, 2, 2, 6)
    cov = np.stack([seen.left_cov, seen.across_cov], axis=1) + FLOOR_PX**2 * np.eye(2)
    half = np.linalg.cholesky(cov)
    white = np.linalg.solve(half, np.concatenate([J, r[..., None]], axis=-1))
    return white[..., :6].reshape(-1, 4, 6), white[..., 6].reshape(-1, 4)


def _seen_at(K: Array, place: Array, by: Array) -> tuple[Array, Array]:
    """Pixels (M, 2) of places (M, 3), and their derivatives (M, 2, 6) where the places' are `by` (M, 3, 6)."""
    z = np.maximum(place[:, 2], 0.05)
    unit = place[:, :2] / z[:, None]
    slope = (by[:, :2] - unit[..., None] * by[:, 2:3]) / z[:, None, None]
    homogeneous = np.column_stack([unit, np.ones(len(unit))])
    return homogeneous @ K[:2].T, K[:2, :2] @ slope


def _index(seen: Sightings, T: int) -> Index:
    """Where each sighting's six derivatives (M, 6) belong among the unknowns."""
    at = 4 * seen.frame
    piece = 4 * T + 3 * seen.piece
    return np.stack([at + ALONG, at + RIGHT, at + UP, piece, piece + 1, piece + 2], axis=1)


def _summed(J: Array, r: Array, weight: Array, seen: Sightings, T: int, F: int) -> tuple[Array, Array]:
    """The sightings' information (n, n) and what it pulls towards (n,)."""
    index = _index(seen, T)
    n = 4 * T + 3 * F
    information, pull = np.zeros((n, n)), np.zeros(n)
    weighted = weight[:, None, None] * J
    np.add.at(information, (index[:, :, None], index[:, None, :]), np.swapaxes(weighted, 1, 2) @ J)
    np.add.at(pull, index, np.einsum("mri,mr->mi", weighted, r))
    return information, pull


def _prior(rules: Rules, seen: Sightings, states: Array, pieces: Array) -> tuple[Array, Array, float]:
    """Information (n, n) of motion and shape, its pull (n,), and the logarithm of its determinant."""
    T, F = states.shape[0], pieces.shape[0]
    n = 4 * T + 3 * F
    information, pull = np.zeros((n, n)), np.zeros(n)
    first = 1 / LOOSE**2
    information[range(4), range(4)] += first
    log_det = float(np.log(first).sum())
    dt = np.diff(seen.t)
    for k, step in enumerate(dt):
        D = np.zeros((4, 8))
        D[:, 4:] = np.eye(4)
        D[:, :4] = -np.eye(4)
        D[ALONG, SPEED] = -step
        Q = np.diag([0.0, 0.0, 5 * step * rules.lateral**2, 5 * step * rules.vertical**2]) + 1e-12 * np.eye(4)
        Q[:2, :2] += 5 * rules.sigma_v**2 * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        weight = np.linalg.inv(Q)
        at = slice(4 * k, 4 * k + 8)
        information[at, at] += D.T @ weight @ D
        pull[at] -= D.T @ weight @ (D @ states[k : k + 2].ravel())
        log_det -= float(np.linalg.slogdet(Q)[1])
    shape = 1 / np.array([rules.relief * rules.height, REACH, REACH]) ** 2
    at = 4 * T + np.arange(3 * F)
    information[at, at] += np.tile(shape, F)
    pull[at] -= (shape * pieces).ravel()
    return information, pull, log_det + F * float(np.log(shape).sum())


def _anchor(rig: StereoRig, way: Way, states: Array, rules: Rules, n: int) -> tuple[Array, Array]:
    """Information (n, n) and pull (n,) of the first quad's middle: it says which point is tracked."""
    s = states[0, ALONG]
    tried = []
    for move in (0.0, STEP, -STEP):
        point, axes = way.frame(np.array(s + move))
        tried.append(point + states[0, RIGHT] * axes[:, 1] + states[0, UP] * axes[:, 2])
    axes = way.frame(np.array(s))[1]
    by = np.column_stack([(tried[1] - tried[2]) / (2 * STEP), axes[:, 1], axes[:, 2]])
    pixel, J = _seen_at(rig.left.K, tried[0][None], np.concatenate([by, np.zeros((3, 3))], axis=1)[None])
    information, pull = np.zeros((n, n)), np.zeros(n)
    at = np.array([ALONG, RIGHT, UP])
    J = J[0, :, :3] / ANCHOR_PX
    information[np.ix_(at, at)] = J.T @ J
    pull[at] = J.T @ ((rules.anchor - pixel[0]) / ANCHOR_PX)
    return information, pull


def _likeliest(
    rules: Rules, sigma_v: float | None, seen: Sightings, states: Array, pieces: Array, data: Array, pull: Array
) -> Rules:
    """The deviation of speed and the relief under which the sightings are likeliest, at this linearisation."""
    tried = rules.pace * SIGMAS if sigma_v is None else np.array([sigma_v])
    score = np.empty((len(tried), len(RELIEFS)))
    for a, sigma in enumerate(tried):
        for b, relief in enumerate(RELIEFS):
            trial = replace(rules, sigma_v=float(sigma), relief=float(relief))
            prior, prior_pull, log_det = _prior(trial, seen, states, pieces)
            factor = cho_factor(data + prior)
            pulled = pull + prior_pull
            own = _prior_cost(trial, seen, states, pieces)
            gained = float(pulled @ cho_solve(factor, pulled))
            log_normal = 2 * float(np.log(np.diag(factor[0])).sum())
            score[a, b] = 0.5 * (log_det - log_normal + gained - own)
        score[a] -= 0.5 * (np.log(sigma / (USUAL * rules.pace)) / SPREAD) ** 2
    weight = np.exp(score - score.max())
    weight /= weight.sum()
    sigma = float(np.exp(weight.sum(axis=1) @ np.log(tried)))
    relief = float(np.exp(weight.sum(axis=0) @ np.log(RELIEFS)))
    return replace(rules, sigma_v=sigma, relief=relief)


def _prior_cost(rules: Rules, seen: Sightings, states: Array, pieces: Array) -> float:
    """Squared deviations of states and pieces from what was known beforehand."""
    dt = np.diff(seen.t)
    d = np.diff(states, axis=0)
    d[:, ALONG] -= states[:-1, SPEED] * dt
    q = 5 * rules.sigma_v**2
    total = 0.0
    for k, step in enumerate(dt):
        Q = q * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]]) + 1e-12 * np.eye(2)
        total += float(d[k, :2] @ np.linalg.solve(Q, d[k, :2]))
    total += float(np.sum(d[:, RIGHT] ** 2 / (5 * dt * rules.lateral**2 + 1e-12)))
    total += float(np.sum(d[:, UP] ** 2 / (5 * dt * rules.vertical**2 + 1e-12)))
    shape = np.array([rules.relief * rules.height, REACH, REACH])
    return total + float(np.sum((pieces / shape) ** 2))


def _shared(seen: Sightings, r: Array) -> float:
    """How much less successive sightings of a piece say than independent ones would, by how alike they err."""
    order = np.lexsort((seen.frame, seen.piece))
    same = np.diff(seen.piece[order]) == 0
    before, after = np.clip(r[order][:-1][same], -4, 4), np.clip(r[order][1:][same], -4, 4)
    if len(before) < 5:
        return 1.0
    alike = float(np.sum(before * after) / np.sqrt(np.sum(before**2) * np.sum(after**2) + 1e-12))
    alike = float(np.clip(alike, 0.0, 0.9))
    return min((1 + alike) / (1 - alike), MOST_SHARED)
