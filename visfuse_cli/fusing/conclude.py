"""What a finished track was: filtered again with the noise that its own residuals speak of, and smoothed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.doubt import stated
from visfuse_cli.fusing.estimate import Sights, at_one_time, fuse, pair_up, stand
from visfuse_cli.fusing.noise import disagreement, restlessness
from visfuse_cli.fusing.person import ASSUMED, BOX, DT, LEVER, VARIANCE, Person, Z
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.tracker import at_rest, held_motion
from visfuse_cli.maths import fusion, fusion_rivals, gaussian
from visfuse_cli.maths.consistency import corrections
from visfuse_cli.maths.fusion_rivals import Bank
from visfuse_cli.maths.gaussian import times
from visfuse_cli.maths.multiview import project
from visfuse_cli.maths.smoothing import rauch_tung_striebel
from visfuse_cli.records import Array, Gaussian

DENIED = 1  # camera or more with a clear sight that speak against a prediction
START_DOUBT = 2.0  # times the deviations a track began with


@dataclass(frozen=True, slots=True)
class Path:
    """A finished track over T instants, in the ground's frame, metres and seconds.

    belief (T, 6); seen (T, C) by which cameras; boxes (T, C, 4) px, NaN where not seen; residual (T, C, 2) px of the
    sightings from the path; weight (T, C) each camera's share of what was measured.
    """

    id: int
    frame: NDArray[np.int64]
    t: Array
    belief: Gaussian
    seen: NDArray[np.bool_]
    boxes: Array
    residual: Array
    weight: Array
    told: NDArray[np.bool_]
    height: float
    noise: float  # the measurement noise that was found, as a share of the nominal one (variance)
    sigma_a: float
    nis: Array  # normalised corrections of the position, of each instant that more than one camera saw
    refused: int
    ended_by: str


def conclude(person: Person, P: Array, config: FuseConfig) -> Path | None:
    """Settle a finished track; None where it was never seen by two cameras for long enough."""
    rows = person.history.rows
    seen = np.isfinite(rows[:, :, 0])
    last = np.flatnonzero(seen.any(axis=1))
    if not person.confirmed or not len(last):
        return None
    person.history.cut(int(last[-1]) + 1)
    rows, seen = person.history.rows, seen[: last[-1] + 1]
    t = np.array(person.history.t)
    pairs = np.flatnonzero(np.count_nonzero(seen, axis=1) >= 2)
    if not len(pairs) or t[pairs[-1]] - t[pairs[0]] < config.life.min_duration_s - 1e-9:
        return None
    frame = np.array(person.history.frame)
    told = (seen.any(axis=1) | (np.array(person.history.denied) < DENIED)) & (frame >= 0)
    state = person.history.state
    sights, lever = _sights(rows, seen, state, P, person.body.ends.mean)
    noise, sigma_a = 1.0, config.filter.sigma_a
    belief, nis = _filtered(person, sights, P, t, state, config, noise, sigma_a)
    pixels, J = project(P[sights.camera], belief.mean[sights.owner, :3])
    if config.filter.adapt and config.smooth:
        noise, once = disagreement(sights, sights.z - pixels, t)
        places = _places(sights, pixels, J, belief, once)
        sigma_a = restlessness(*places, t, config.filter, person.start)
        belief, nis = _filtered(person, sights, P, t, state, config, noise, sigma_a)
        pixels, J = project(P[sights.camera], belief.mean[sights.owner, :3])
    centroid = config.fusion.point == "centroid"
    belief = stated(belief, sights, J, lever, person.body.ends.cov, noise, centroid)
    told &= (np.count_nonzero(seen, axis=1) != 1) | (_aside(belief) < config.life.max_doubt)
    if not told.any():
        return None
    residual = np.full((*seen.shape, 2), np.nan)
    residual[sights.owner, sights.camera] = sights.z - pixels
    return Path(
        id=person.id,
        frame=frame,
        t=t,
        belief=belief,
        seen=seen,
        boxes=rows[:, :, BOX],
        residual=residual,
        weight=_weights(sights, J, seen.shape),
        told=told,
        height=person.body.ends.height,
        noise=noise,
        sigma_a=sigma_a,
        nis=nis,
        refused=person.refused,
        ended_by=person.ended_by,
    )


def _aside(belief: Gaussian) -> Array:
    """The largest deviation (T,) m along the ground of beliefs (T, 6)."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(belief.cov[:, :2, :2])[:, -1]))


def _sights(rows: Array, seen: NDArray[np.bool_], state: Array, P: Array, ends: Array) -> tuple[Sights, Array]:
    """All sightings of a track, the instants as owners, brought to the instants of the sets; and their levers (M, 3).

    The body's `ends` (3,) m as known at the end take the place of what was assumed at the time.
    """
    owner, camera = np.nonzero(seen)
    own = rows[owner, camera]
    lever = own[:, LEVER]
    _, J = project(P[camera], state[owner, :3])
    z = own[:, Z] + J[:, :, 2] * (lever @ ends - own[:, ASSUMED])[:, None]
    a, b, c = own[:, VARIANCE].T
    R = np.stack([np.stack([a, b], axis=-1), np.stack([b, c], axis=-1)], axis=-2)
    sights = Sights(owner, camera, z, R, own[:, DT])
    return at_one_time(sights, P, Gaussian(state, np.zeros((len(state), 6, 6)))), lever


def _filtered(
    person: Person,
    sights: Sights,
    P: Array,
    t: Array,
    state: Array,
    config: FuseConfig,
    noise: float,
    sigma_a: float,
) -> tuple[Gaussian, Array]:
    """Beliefs (T, 6) with the measurement noise scaled, smoothed where asked for; normalised corrections (k,)."""
    scaled = Sights(sights.owner, sights.camera, sights.z, sights.R * noise, sights.dt)
    start = Gaussian(person.start.mean, person.start.cov * START_DOUBT**2)
    belief = at_rest(start, sigma_a, config.filter)
    step = _pairwise_step(scaled, P, state[:, :3]) if config.fusion.method == "closed-loop" else None
    bank: Bank | None = None
    prior, posterior, transitions = [], [], []
    bounds = np.searchsorted(scaled.owner, np.arange(len(t) + 1))
    level = person.body.level(config.fusion.point == "centroid")
    for k in range(len(t)):
        dt = float(t[k] - t[k - 1]) if k else 0.0
        F, Q = held_motion(dt, sigma_a, config.filter)
        ahead = gaussian.predict(belief, F, Q) if k else belief
        now = slice(bounds[k], bounds[k + 1])
        if now.start == now.stop:
            belief = ahead
            bank = fusion_rivals.predicted(bank, F, Q) if bank is not None else None
        elif step is not None:
            belief = step(k, ahead)
        else:
            bank = fusion_rivals.predicted(bank, F, Q) if bank is not None else None
            one = Sights(0 * scaled.owner[now], scaled.camera[now], scaled.z[now], scaled.R[now], scaled.dt[now])
            banks: list[Bank | None] = [bank]
            after = fuse(config.fusion.method, Gaussian(ahead.mean[None], ahead.cov[None]), one, P, banks)
            belief, bank = Gaussian(after.mean[0], after.cov[0]), banks[0]
        if now.stop - now.start == 1:
            belief = stand(belief, *level, dt)
        prior.append(ahead)
        posterior.append(belief)
        transitions.append(F)
    filtered, predicted = (
        Gaussian(np.stack([b.mean for b in beliefs]), np.stack([b.cov for b in beliefs]))
        for beliefs in (posterior, prior)
    )
    settled = rauch_tung_striebel(filtered, predicted, np.stack(transitions)) if config.smooth else filtered
    return Gaussian(settled.mean[:, :6], settled.cov[:, :6, :6]), corrections(predicted, filtered, 3)


def _pairwise_step(sights: Sights, P: Array, near: Array) -> Callable[[int, Gaussian], Gaussian]:
    """The closed loop's step k from a prediction (9,), all pairs of all instants triangulated at once."""
    pairs = pair_up(sights, P, near)
    order = np.argsort(pairs.owner, kind="stable")
    y, R = pairs.y[order], pairs.R[order]
    bounds = np.searchsorted(pairs.owner[order], np.arange(len(near) + 1))
    alone = sights.of(pairs.lone)
    lone = np.searchsorted(alone.owner, np.arange(len(near) + 1))

    def step(k: int, prior: Gaussian) -> Gaussian:
        belief = Gaussian(prior.mean[None], prior.cov[None])
        now = slice(bounds[k], bounds[k + 1])
        belief = fusion.closed_loop(belief, np.zeros(now.stop - now.start, dtype=np.intp), y[now], R[now])
        now = slice(lone[k], lone[k + 1])
        who = np.zeros(now.stop - now.start, dtype=np.intp)
        belief = fusion.central(belief, who, P[alone.camera[now]], alone.z[now], alone.R[now])
        return Gaussian(belief.mean[0], belief.cov[0])

    return step


def _places(sights: Sights, pixels: Array, J: Array, belief: Gaussian, noise: float) -> tuple[Array, Array]:
    """Where each instant's sightings alone, their noise scaled, put the person: (T, 3) and (T, 3, 3); NaN without."""
    weight = np.linalg.inv(sights.R * noise)
    information, vector = np.zeros((len(belief.mean), 3, 3)), np.zeros((len(belief.mean), 3))
    J_W = np.swapaxes(J, -1, -2) @ weight
    np.add.at(information, sights.owner, J_W @ J)
    np.add.at(vector, sights.owner, times(J_W, sights.z - pixels))
    known = np.bincount(sights.owner, minlength=len(belief.mean)) >= 2
    R = np.full_like(information, np.nan)
    R[known] = np.linalg.pinv(information[known], hermitian=True)
    return belief.mean[:, :3] + times(R, vector), R


def _weights(sights: Sights, J: Array, shape: tuple[int, ...]) -> Array:
    """Each camera's share (T, C) of the information about the position."""
    own = np.swapaxes(J, -1, -2) @ np.linalg.inv(sights.R) @ J
    total = np.zeros((shape[0], 3, 3))
    np.add.at(total, sights.owner, own)
    share = np.trace(np.linalg.pinv(total)[sights.owner] @ own, axis1=-2, axis2=-1) / 3
    weight = np.zeros(shape)
    weight[sights.owner, sights.camera] = share
    return weight
