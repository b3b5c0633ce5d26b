"""What a finished track on the ground was, and how well its gaze was predicted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from visfuse_cli.gazing.head import ground_shift
from visfuse_cli.gazing.target import Look, Target, belief
from visfuse_cli.maths import gaussian, motion
from visfuse_cli.maths.angles import wrap
from visfuse_cli.records import Array, Gaussian, GroundMap

Z95 = 1.959963984540054
ANGLE_Q = (0.01, 0.1, 1.0)  # rad^2 s^-3 of a constant velocity of angles: the best of them is the rival
SETTLED_S = 1.0
SLOWEST = 0.12  # m/s


@dataclass(frozen=True, slots=True)
class _Part:
    """What was seen of a target without a break: looks, beliefs mean (T, 4) and cov (T, 4, 4), log mu, predictions."""

    looks: list[Look]
    mean: Array
    cov: Array
    log_mu: Array
    ahead: list[Gaussian | None]


def conclude(target: Target, ground: GroundMap) -> dict[str, Any] | None:
    """One track of tracks.json; None where it was seen too rarely, or was found unaided and went nowhere."""
    chain = [target]
    while (earlier := chain[-1].earlier) is not None:
        chain.append(earlier)
    parts = [part for each in chain[::-1] if (part := _part(each, ground)) is not None]
    looks = [look for part in parts for look in part.looks]
    seen = np.array([look.z is not None for look in looks])
    life = target.config.life
    if np.count_nonzero(seen) < life.min_frames:
        return None
    mean, cov, log_mu = (np.concatenate([getattr(part, name) for part in parts]) for name in ("mean", "cov", "log_mu"))
    ahead = [each for part in parts for each in part.ahead]
    t = np.array([look.t for look in looks])
    duration = float(t[-1] - t[0])
    distance = float(np.sum(np.hypot(*np.diff(mean[:, :2], axis=0).T)))
    off = np.hypot(*(mean[:, :2] - mean[0, :2]).T)
    far = int(np.argmax(off))  # it may come back
    if not target.given and (off[far] < life.min_moved or off[far] < SLOWEST * (t[far] - t[0])):
        return None
    names = target.models.names
    return {
        "id": target.id,
        "summary": _summary(target, t, seen, distance, duration, cov),
        "states": [
            _state(target, looks[k], ahead[k], mean[k], cov[k], dict(zip(names, np.exp(log_mu[k]), strict=True)))
            for k in range(len(looks))
        ],
    }


def _part(target: Target, ground: GroundMap) -> _Part | None:
    """What was seen of a target without a break, up to its last measurement; None where that is next to nothing."""
    measured = [k for k, look in enumerate(target.looks) if look.z is not None]
    if not target.steps or len(measured) < 2:
        return None
    last = measured[-1] + 1
    steps = target.steps[:last]
    t = np.array([look.t for look in target.looks[:last]])
    banks = target.models.smoothed(steps, t) if target.config.smooth else [step.filtered for step in steps]
    beliefs = [belief(bank) for bank in banks]
    mean, cov = np.stack([b.mean for b in beliefs]), np.stack([b.cov for b in beliefs])
    J = ground_shift(ground, mean[:, :2])
    cov[:, :2, :2] += J @ ground.cov @ np.swapaxes(J, 1, 2)
    return _Part(target.looks[:last], mean, cov, np.stack([bank.log_mu for bank in banks]), target.ahead[:last])


def _summary(target: Target, t: Array, seen: Array, distance: float, duration: float, cov: Array) -> dict[str, Any]:
    speed = distance / duration
    doubt = float(np.sqrt(np.trace(cov[0, :2, :2]) / 2 + np.trace(cov[-1, :2, :2]) / 2)) / duration
    ahead = prediction_errors(target)
    predicted = {} if ahead is None else {"prediction_rms_2d": ahead[0], "prediction_rms_3d": ahead[1]}
    return {
        "t_start": float(t[0]),
        "t_end": float(t[-1]),
        "n_frames": int(np.count_nonzero(seen)),
        "distance": distance,
        "speed": speed,
        "speed_ci95": [max(0.0, speed - Z95 * doubt), speed + Z95 * doubt],
        "nis_mean": float(np.mean(target.nis)) if target.nis else 0.0,
        "nis_dof": 4,
        "size": target.size.tolist(),
        "ended": target.ended_by,
        **predicted,
    }


def _state(
    target: Target, look: Look, later: Gaussian | None, mean: Array, cov: Array, models: dict[str, float]
) -> dict[str, Any]:
    speed = float(np.hypot(*mean[2:]))
    unit = mean[2:] / max(speed, 1e-6)
    state: dict[str, Any] = {
        "frame": look.frame,
        "t": look.t,
        "position": mean[:2].tolist(),
        "velocity": mean[2:].tolist(),
        "covariance": ((cov + cov.T) / 2).tolist(),
        "speed": speed,
        "speed_sigma": float(np.sqrt(max(float(unit @ cov[2:, 2:] @ unit), 0.0))),
        "box": {"left": look.box.tolist()},
        "measured": look.z is not None,
    }
    if len(models) > 1:
        state["models"] = {name: float(share) for name, share in models.items()}
    if later is not None:
        state["ahead"] = {"t": look.t + target.config.latency, "position": later.mean[:2].tolist()}
    return state


def prediction_errors(target: Target) -> tuple[float, float] | None:
    """RMS (rad) of the direction to the target a latency ahead: told by its angles alone (2D), and by the ground (3D).

    Against the direction in which it was then measured. Bradshaw 1997, sec. 6. None where there is too little of it.
    """
    latency = target.config.latency
    seen = [k for k, look in enumerate(target.looks) if look.z is not None and k < len(target.steps)]
    if latency <= 0 or len(seen) < 10:
        return None
    t = np.array([target.looks[k].t for k in seen])
    angles = np.array([_direction(target, z[:2]) for k in seen if (z := target.looks[k].z) is not None])
    angles = np.unwrap(angles, axis=0)  # the ground's axes may lie any way
    used = [i for i in range(len(seen)) if t[i] - t[0] >= SETTLED_S and t[i] + latency <= t[-1]]
    if len(used) < 5:
        return None
    truth = np.column_stack([np.interp(t[used] + latency, t, angles[:, c]) for c in (0, 1)])
    told = np.array([_direction(target, b.mean[:2]) for i in used if (b := target.ahead[seen[i]]) is not None])
    plane = min(_angles_ahead(t, angles, used, latency, q, truth) for q in ANGLE_Q)
    return plane, float(np.sqrt(np.mean(np.sum(wrap(told - truth) ** 2, axis=1))))


def _direction(target: Target, place: Array) -> Array:
    """Elevation and azimuth (2,) rad of a place (2,) m on the ground, seen from the head."""
    right, ahead, up = np.append(place, target.height) - target.head.centre
    return np.array([np.arctan2(up, np.hypot(right, ahead)), np.arctan2(right, ahead)])


def _angles_ahead(t: Array, angles: Array, used: list[int], latency: float, q: float, truth: Array) -> float:
    sigma = 2e-3
    belief_ = Gaussian(np.append(angles[0], [0.0, 0.0]), np.diag([sigma, sigma, 0.5, 0.5]) ** 2)
    told = {}
    for i in range(1, len(t)):
        dt = t[i] - t[i - 1]
        ahead = gaussian.predict(belief_, motion.constant_velocity(dt), motion.constant_velocity_noise(dt, q))
        residual = angles[i] - ahead.mean[:2]
        belief_, _ = gaussian.update(ahead, residual, np.eye(2, 4), sigma**2 * np.eye(2))
        told[i] = belief_.mean[:2] + latency * belief_.mean[2:]
    off = np.array([told[i] for i in used]) - truth
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
