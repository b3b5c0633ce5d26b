"""For comparison: the patch triangulated at each instant, its middle followed by a Kalman filter. Zhu 2012, sec. V."""

from __future__ import annotations

import numpy as np

from visfuse_cli.facing.conclude import Settled, mean_pair
from visfuse_cli.facing.front import Target
from visfuse_cli.maths import gaussian
from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import triangulated
from visfuse_cli.maths.smoothing import rauch_tung_striebel
from visfuse_cli.records import Array, Gaussian

USUAL_SIGMA = 0.15  # m/s a frame at 5 frames/s
STEP_PX = 0.05  # of the numerical derivatives
LOOSE = np.diag([1e3] * 3 + [80.0] * 3) ** 2
H = np.eye(3, 6)


def follow_triangulated(target: Target) -> Settled | None:
    """Settle a track from its triangulated middles alone; None where it was measured in too few frames."""
    life = target.config.life
    if len(target.looks) < max(life.min_frames, life.min_share * len(target.causal)):
        return None
    t = np.array([look.t for look in target.looks])
    places, noise = _places(target)
    sigma_v = target.config.filter.sigma_v or USUAL_SIGMA
    belief = Gaussian(np.concatenate([places[0], np.zeros(3)]), LOOSE)
    filtered, predicted, transitions, nis = [], [], [], []
    for k in range(len(t)):
        dt = float(t[k] - t[k - 1]) if k else 0.0
        F = np.eye(6)
        F[:3, 3:] = dt * np.eye(3)
        Q = 5 * sigma_v**2 * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(3))
        ahead = gaussian.predict(belief, F, Q + 1e-12 * np.eye(6)) if k else belief
        belief, innovation = gaussian.update(ahead, places[k] - ahead.mean[:3], H, noise[k])
        nis.append(float(innovation.nis))
        filtered.append(belief)
        predicted.append(ahead)
        transitions.append(F)
    after = _stacked(filtered)
    if target.config.smooth:
        after = rauch_tung_striebel(after, _stacked(predicted), np.stack(transitions))
    return _settled(target, t, after, sigma_v, nis[1:])


def _places(target: Target) -> tuple[Array, Array]:
    """Triangulated middles (T, 3) m of the patch, and their covariances (T, 3, 3)."""
    z, R = (np.stack([getattr(look, name) for look in target.looks])[:, [0, 1, 3, 4]] for name in ("z", "R"))
    tried = z[:, None] + STEP_PX * np.concatenate([np.zeros((1, 4)), np.eye(4), -np.eye(4)])[None]
    points = triangulated(target.rig, tried[..., :2], tried[..., 2:])
    J = np.swapaxes((points[:, 1:5] - points[:, 5:9]) / (2 * STEP_PX), 1, 2)
    return points[:, 0], J @ R[:, :, [0, 1, 3, 4]] @ np.swapaxes(J, 1, 2)


def _stacked(beliefs: list[Gaussian]) -> Gaussian:
    return Gaussian(np.stack([each.mean for each in beliefs]), np.stack([each.cov for each in beliefs]))


def _settled(target: Target, t: Array, belief: Gaussian, sigma_v: float, nis: list[float]) -> Settled:
    velocity = belief.mean[:, 3:]
    speed = np.linalg.norm(velocity, axis=1)
    along = velocity / np.maximum(speed, 1e-9)[:, None]
    sigma = np.sqrt(np.einsum("ta,tab,tb->t", along, belief.cov[:, 3:, 3:], along))
    mean_speed, mean_sigma = mean_pair(speed, sigma, target.config.smooth)
    places = belief.mean[:, :3]
    return Settled(
        id=target.id,
        frame=[look.frame for look in target.looks],
        t=t,
        belief=belief,
        speed=speed,
        speed_sigma=sigma,
        measured=np.ones(len(t), dtype=bool),
        quads=[look.quads for look in target.looks],
        mean_speed=mean_speed,
        mean_sigma=mean_sigma,
        distance=float(np.linalg.norm(places[-1] - places[0])),
        noise=1.0,
        sigma_v=sigma_v,
        relief=0.0,
        way=Way(np.stack([places[0], places[-1] + [0, 0, 1e-3]])),
        ended_by=target.ended_by,
        nis=nis,
        nis_dof=3,
    )
