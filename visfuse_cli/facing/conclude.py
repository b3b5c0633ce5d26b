"""What a finished track was: its measurements filtered and smoothed along the path, and the speed they tell."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from visfuse_cli.facing.target import LATERAL, VERTICAL, S, Shape, Target, V, drift, expected, middle
from visfuse_cli.facing.target import shape_of as front_of
from visfuse_cli.maths import gaussian
from visfuse_cli.maths.paths import Way, through
from visfuse_cli.maths.planes import triangulated
from visfuse_cli.maths.smoothing import Smoothed, cross_covariance, rauch_tung_striebel
from visfuse_cli.records import Array, Gaussian, StereoRig

Z95 = 1.959963984540054
ROUNDS = 3  # of linearisation
SHOWN = 0.2  # of its own height, or of the logarithm of it: what a moving thing changes in the picture
ALIKE = 0.8  # median correlation
SHARED_S = 0.2  # s for which the patch errs alike: pictures nearer in time do not add to each other
GRID = np.array([0.01, 0.03, 0.1, 0.25, 0.6, 1.5, 4.0])  # m/s a frame at 5 frames/s
USUAL, SPREAD = 0.06, 1.2  # of the deviation of speed, and of its logarithm, before anything is known
STEP = np.array([0.01, 0.01, 0.01, 0.01, 1e-4])  # of the numerical Jacobians
DRIFT_SPEED = 0.05  # m/s across the path
PATH_SPEED_SHARE = 0.001  # of the speed: what the path's own direction may add


@dataclass(frozen=True, slots=True)
class Settled:
    """A finished track over T instants in the left camera's frame: belief of position and velocity (T, 6), and so on.

    speed and speed_sigma (T,) m/s; measured (T,); summary speed with its deviation over `distance` m.
    """

    id: int
    frame: list[int]
    t: Array
    belief: Gaussian
    speed: Array
    speed_sigma: Array
    measured: Array
    quads: list[dict[str, Array]]
    corners: Array  # (T, 4, 3) m
    mean_speed: float
    mean_sigma: float
    distance: float
    nis: float
    sigma_v: float
    way: Way
    ended_by: str


def conclude(target: Target) -> Settled | None:
    """Settle a track; None where it was measured in too few frames, or found unaided and did not move."""
    life = target.config.life
    if len(target.looks) < max(life.min_frames, life.min_share * len(target.causal)):
        return None
    if not target.on_path and target.config.filter.path_constraint:
        target = _with_way(target)
    t = np.array([look.t for look in target.looks])
    sigma_v, smoothed, nis = _best(target, t)
    settled = _settled(target, t, smoothed, sigma_v, nis)
    if not target.given and not _moved(target, settled):
        return None
    return settled if target.config.smooth else _causal(target, settled)


def _moved(target: Target, settled: Settled) -> bool:
    """Whether what was found unaided went anywhere, in space and in the picture, and looked like itself all the way."""
    place = settled.belief.mean[:, :3]
    net = float(np.linalg.norm(place[-1] - place[0]))
    first, last = target.looks[0].z, target.looks[-1].z
    size = np.exp(first[2])
    shown = max(float(np.linalg.norm(last[:2] - first[:2])) / size, abs(float(last[2] - first[2])))
    alike = float(np.median([look.correlation for look in target.looks]))
    return net > target.config.life.min_distance and shown > SHOWN and alike > ALIKE


def _with_way(target: Target) -> Target:
    """The same measurements along the path that they themselves lie on."""
    rig = target.rig
    z = np.stack([look.z for look in target.looks])
    points = triangulated(rig, z[:, :2], z[:, 3:])
    spread = np.array([look.R[3, 3] + look.R[0, 0] - 2 * look.R[0, 3] for look in target.looks])
    sigma = points[:, 2] ** 2 / (rig.left.K[0, 0] * rig.baseline) * np.sqrt(spread + 0.05**2)
    way = through(points, sigma, 25.0)
    first = target.looks[0]
    shape, _ = front_of(rig, way, first.quads["left"], float(points[0, 2]))
    return replace(target, way=way, shape=shape, on_path=True)


def _best(target: Target, t: Array) -> tuple[float, Smoothed, float]:
    """The deviation of speed that explains the measurements best, and the smoothed states (T, 5) with it."""
    asked = target.config.filter.sigma_v
    if asked is not None:
        smoothed, _, nis = _smoothed(target, t, asked)
        return asked, smoothed, nis
    score = []
    for sigma in GRID:
        _, likelihood, nis = _smoothed(target, t, float(sigma))
        # Were the noise what the innovations say it is, this would be the likelihood.
        freedom = len(_rows(target)) * max(len(t) - 2, 1)
        if nis > 1:
            likelihood += 0.5 * freedom * (nis - 1 - np.log(nis))
        score.append(likelihood - 0.5 * (np.log(sigma / USUAL) / SPREAD) ** 2)
    weight = np.exp(np.array(score) - max(score))
    sigma = float(np.exp(np.sum(weight * np.log(GRID)) / weight.sum()))
    smoothed, _, nis = _smoothed(target, t, sigma)
    return sigma, smoothed, nis


def _smoothed(target: Target, t: Array, sigma_v: float) -> tuple[Smoothed, float, float]:
    """States (T, 5), log-likelihood, and NIS a degree of freedom: an extended filter and smoother, linearised anew."""
    about = _start(target, t)
    smoothed, likelihood, nis = _pass(target, t, sigma_v, about)
    for _ in range(ROUNDS - 1):
        smoothed, likelihood, nis = _pass(target, t, sigma_v, smoothed.mean)
    return smoothed, likelihood, nis


def _start(target: Target, t: Array) -> Array:
    """States (T, 5) of the measured places, roughly."""
    z = np.stack([look.z for look in target.looks])
    points = triangulated(target.rig, z[:, :2], z[:, 3:])
    s = np.array([target.way.nearest(point) for point in points])
    state = np.zeros((len(t), 5))
    state[:, S] = s
    state[:, V] = np.polyfit(t - t[0], s, 1)[0] if len(t) > 1 else 0.0
    place, axes = target.way.frame(s)
    off = np.einsum("tab,ta->tb", axes, points - place)
    state[:, LATERAL], state[:, VERTICAL] = off[:, 1], off[:, 2]
    return state


def _pass(target: Target, t: Array, sigma_v: float, about: Array) -> tuple[Smoothed, float, float]:
    """One run forth and back, linearised about states (T, 5)."""
    lateral, vertical = drift(target)
    h, H = _expected(target.rig, target.way, target.shape, about)
    prior = Gaussian(about[0].copy(), np.diag([30.0, 60.0, 5.0, 5.0, 0.5]) ** 2)
    belief = prior
    filtered, predicted, transitions = [], [], []
    likelihood, nis, freedom = 0.0, 0.0, 0
    shared = max(1.0, SHARED_S / float(np.median(np.diff(t)))) if len(t) > 1 else 1.0
    for k, look in enumerate(target.looks):
        dt = float(t[k] - t[k - 1]) if k else 0.0
        F = np.eye(5)
        F[S, V] = dt
        Q = np.zeros((5, 5))
        q = 5 * sigma_v**2
        Q[np.ix_([S, V], [S, V])] = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        Q[LATERAL, LATERAL], Q[VERTICAL, VERTICAL] = 5 * dt * lateral**2, 5 * dt * vertical**2
        Q += 1e-12 * np.eye(5)
        ahead = gaussian.predict(belief, F, Q) if k else prior
        rows = _rows(target)
        residual = look.z - h[k] - H[k] @ (ahead.mean - about[k])
        R = shared * look.R[np.ix_(rows, rows)]
        belief, innovation = gaussian.update(ahead, residual[rows], H[k][rows], R)
        if k > 1:
            likelihood += float(innovation.log_likelihood)
            nis, freedom = nis + float(innovation.nis), freedom + len(rows)
        filtered.append(belief)
        predicted.append(ahead)
        transitions.append(F)
    after, before = (
        Gaussian(np.stack([b.mean for b in beliefs]), np.stack([b.cov for b in beliefs]))
        for beliefs in (filtered, predicted)
    )
    return rauch_tung_striebel(after, before, np.stack(transitions)), likelihood, nis / max(freedom, 1)


def _rows(target: Target) -> list[int]:
    """Which components are used: with `triangulation`, for comparison, the two middles alone."""
    return [0, 1, 3, 4] if target.config.filter.kind == "triangulation" else [0, 1, 2, 3, 4]


def _expected(rig: StereoRig, way: Way, shape: Shape, states: Array) -> tuple[Array, Array]:
    """What would be measured (T, 5) at states (T, 5), and the Jacobians (T, 5, 5), by central differences."""
    tried = states[:, None, :] + np.concatenate([np.zeros((1, 5)), np.diag(STEP), -np.diag(STEP)])[None]
    z = expected(rig, way, shape, tried)
    H = (z[:, 1:6] - z[:, 6:11]) / (2 * STEP[None, :, None])
    return z[:, 0], np.swapaxes(H, 1, 2)


def _settled(target: Target, t: Array, smoothed: Smoothed, sigma_v: float, nis: float) -> Settled:
    """Positions, velocities and the mean speed, with what is not known of them."""
    mean, cov = smoothed.mean, smoothed.cov
    if nis > 1:  # the patch was not as flat, or its noise not as small, as was taken
        cov = cov * nis
    place = middle(target.way, mean)
    J = _motion(target.way, mean)
    velocity = J[:, :3, S] * mean[:, V, None]
    full = np.zeros((len(t), 6, 5))
    full[:, :3] = J
    full[:, 3:, V] = J[:, :, S]
    belief = Gaussian(np.concatenate([place, velocity], axis=1), _with_drift(full @ cov @ np.swapaxes(full, 1, 2), J))
    stretch = np.linalg.norm(J[:, :, S], axis=1)  # beside a curved path the way is longer, or shorter
    speed = np.abs(mean[:, V]) * stretch
    distance = float(np.sum(np.linalg.norm(np.diff(place, axis=0), axis=1))) if len(t) > 1 else 0.0
    way = abs(float(np.sum((stretch[1:] + stretch[:-1]) / 2 * np.diff(mean[:, S]))))
    duration = float(t[-1] - t[0])
    cross = cross_covariance(smoothed, 0, len(t) - 1)[S, S] * (nis if nis > 1 else 1.0)
    variance = (cov[0, S, S] + cov[-1, S, S] - 2 * cross) * float(np.mean(stretch)) ** 2
    mean_speed = way / duration
    sigma = float(np.hypot(np.sqrt(max(variance, 0.0)) / duration, PATH_SPEED_SHARE * mean_speed))
    return Settled(
        id=target.id,
        frame=[look.frame for look in target.looks],
        t=t,
        belief=belief,
        speed=speed,
        speed_sigma=np.sqrt(cov[:, V, V]) * stretch,
        measured=np.ones(len(t), dtype=bool),
        quads=[look.quads for look in target.looks],
        corners=target.shape.points(target.way, mean),
        mean_speed=mean_speed,
        mean_sigma=sigma,
        distance=distance,
        nis=nis,
        sigma_v=sigma_v,
        way=target.way,
        ended_by=target.ended_by,
    )


def _with_drift(cov: Array, J: Array) -> Array:
    """Covariances (T, 6, 6) with what is not known of the velocity across the path; J (T, 3, 5) as of `_motion`."""
    cov = cov.copy()
    along = J[:, :, S] / np.linalg.norm(J[:, :, S], axis=1, keepdims=True)
    cov[:, 3:, 3:] += DRIFT_SPEED**2 * (np.eye(3) - along[:, :, None] * along[:, None, :])
    return (cov + np.swapaxes(cov, 1, 2)) / 2


def _motion(way: Way, states: Array) -> Array:
    """d middle / d state (T, 3, 5)."""
    tried = states[:, None, :] + np.concatenate([np.diag(STEP), -np.diag(STEP)])[None]
    place = middle(way, tried)
    return np.swapaxes((place[:, :5] - place[:, 5:]) / (2 * STEP[None, :, None]), 1, 2)


def _causal(target: Target, settled: Settled) -> Settled:
    """The particles' own output, instant by instant, in place of the smoothed states."""
    kept = [entry for entry in target.causal if entry[1] <= settled.t[-1] + 1e-9]
    states = np.stack([belief.mean for _, _, belief, _ in kept])
    cov = np.stack([belief.cov for _, _, belief, _ in kept])
    t = np.array([entry[1] for entry in kept])
    J = _motion(target.way, states)
    full = np.zeros((len(t), 6, 5))
    full[:, :3] = J
    full[:, 3:, V] = J[:, :, S]
    place = middle(target.way, states)
    velocity = J[:, :, S] * states[:, V, None]
    stretch = np.linalg.norm(J[:, :, S], axis=1)
    quads = {look.frame: look.quads for look in target.looks}
    return replace(
        settled,
        frame=[entry[0] for entry in kept],
        t=t,
        belief=Gaussian(
            np.concatenate([place, velocity], axis=1), _with_drift(full @ cov @ np.swapaxes(full, 1, 2), J)
        ),
        speed=np.abs(states[:, V]) * stretch,
        speed_sigma=np.sqrt(cov[:, V, V]) * stretch,
        measured=np.array([entry[3] for entry in kept]),
        quads=[quads.get(entry[0], {}) for entry in kept],
        corners=target.shape.points(target.way, states),
    )
