"""How late each camera's clock is: first by where on the ground people are seen at what time, then by their tracks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.audit import LEAST
from visfuse_cli.fusing.conclude import conclude
from visfuse_cli.fusing.person import Person
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.maths import multiview, people
from visfuse_cli.maths.gaussian import times
from visfuse_cli.records import Array

STEP_S = 0.05  # of the coarse search
NEAR_M = 0.35  # m by which one camera alone misses a place on the ground
TALL = (0.55, 1.4)  # share of the usual height that a blob of one person has
ROUNDS, SETTLED_S = 8, 0.001  # of the fine search: rounds at most, and the step (s) at which it ends
UNLIKELY = 0.05  # gain in agreement from which on a shift is believed


@dataclass(slots=True)
class Walks:
    """Where one camera alone saw people: times (n,) s on its own clock, and places (k, 2) m at each of them."""

    t: list[float] = field(default_factory=list)
    places: list[Array] = field(default_factory=list)

    def add(self, t: float, places: Array) -> None:
        """Take in one frame's."""
        self.t.append(t)
        self.places.append(places)


def places_alone(P: Array, boxes: Array, size: Array, height: float, width: float) -> Array:
    """Ground places (k, 2) m of those boxes [u0, v0, u1, v1] (n, 4) px of one camera P (3, 4) that fit one person."""
    foot = np.column_stack([(boxes[:, 0] + boxes[:, 2]) / 2, boxes[:, 3]])
    place, _ = multiview.on_plane(P, foot)
    good = np.isfinite(place).all(axis=1) & np.all((boxes[:, :2] > 1) & (boxes[:, 2:] < size - 2), axis=1)
    place, boxes = place[good], boxes[good]
    standing = np.column_stack([place, np.zeros(len(place))])
    usual = np.full(len(place), height), np.full(len(place), width)
    expected = people.boxes(P, people.outline(standing, *usual))
    with np.errstate(invalid="ignore"):
        share = (boxes[:, 3] - boxes[:, 1]) / (expected[:, 3] - expected[:, 1])
        return np.asarray(place[(share > TALL[0]) & (share < TALL[1])])


def coarse(walks: list[Walks], offsets: Array, largest: float) -> Array | None:
    """Seconds (C,) to add to each camera's times, near `offsets` (C,), the first camera's kept; None without a clue.

    The camera that agrees best with those already settled is settled next.
    """
    found, settled = offsets.copy(), [0]
    while len(settled) < len(walks):
        best: tuple[float, int, float] | None = None
        for camera in (c for c in range(len(walks)) if c not in settled):
            shifts = offsets[camera] + np.arange(-largest, largest + STEP_S / 2, STEP_S)
            score = sum(_agreement(walks[other], found[other], walks[camera], shifts) for other in settled)
            gain, peak = float(np.max(score) - np.median(score)), float(shifts[int(np.argmax(score))])
            if best is None or gain > best[0]:
                best = (gain, camera, peak)
        assert best is not None
        if best[0] < UNLIKELY:
            return None
        found[best[1]] = best[2]
        settled.append(best[1])
    return found


def _agreement(one: Walks, offset: float, other: Walks, shifts: Array) -> Array:
    """How often people of one camera are where another camera sees them, for each shift (S,) of the other's clock."""
    score = np.zeros(len(shifts))
    if not one.t or not other.t:
        return score
    t, own = np.array(other.t), np.array(one.t) + offset
    tolerance = 0.6 * float(np.median(np.diff(t))) if len(t) > 1 else STEP_S
    count = np.zeros(len(shifts))
    for k, shift in enumerate(shifts):
        nearest = _nearest(t + shift, own)
        for i in np.flatnonzero(np.abs(t[nearest] + shift - own) <= tolerance):
            here, there = one.places[i], other.places[nearest[i]]
            if len(here) and len(there):
                apart = np.linalg.norm(here[:, None] - there[None], axis=-1).min(axis=1)
                score[k] += np.mean(np.exp(-0.5 * (apart / NEAR_M) ** 2))
                count[k] += 1
    enough = count >= max(5.0, 0.3 * count.max(initial=0.0))
    return np.where(enough, score / np.maximum(count, 1), 0.0)


def _nearest(t: Array, when: Array) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(t, when), 1, len(t) - 1) if len(t) > 1 else np.zeros(len(when), dtype=np.intp)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(t[left] - when) <= np.abs(t[right] - when), left, right)


def refined(people: list[Person], P: Array, config: FuseConfig) -> Array:
    """How much later (C,) s than thought cameras P (C, 3, 4) saw people, by their settled paths; the first one's is 0.

    A late camera drags the paths after itself, so that only a share of its lateness shows at once: in several rounds,
    all of it does. A camera of which too little is known is left as it is.
    """
    plain = config.model_copy(update={"filter": config.filter.model_copy(update={"adapt": False})})
    total = np.zeros(len(P))
    for _ in range(ROUNDS):
        pull, weight, count = np.zeros(len(P)), np.zeros(len(P)), np.zeros(len(P), dtype=int)
        for path in (conclude(person, P, plain) for person in people):
            if path is None:
                continue
            _, J = multiview.project(P, path.belief.mean[:, None, :3])
            moved = times(J, path.belief.mean[:, None, 3:])  # px/s in each picture
            known = path.seen & (np.count_nonzero(path.seen, axis=1) >= 2)[:, None]
            scale = np.where(known, np.sum(J**2, axis=(-2, -1)), 1.0)
            pull += np.where(known, np.sum(moved * np.nan_to_num(path.residual), axis=-1) / scale, 0.0).sum(axis=0)
            weight += np.where(known, np.sum(moved**2, axis=-1) / scale, 0.0).sum(axis=0)
            count += known.sum(axis=0)
        late = np.where(count >= LEAST, pull / np.maximum(weight, 1e-9), 0.0)
        late -= late[0]
        for person in people:
            person.history.delay(late)
        total += late
        if np.abs(late).max() < SETTLED_S:
            break
    return total
