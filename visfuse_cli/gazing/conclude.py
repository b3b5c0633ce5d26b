"""What a finished track on the ground was, and how well its gaze was predicted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.gazing.head import ground_shift
from visfuse_cli.gazing.target import Target, belief
from visfuse_cli.maths import gaussian, motion
from visfuse_cli.maths.angles import wrap
from visfuse_cli.maths.gaussian import symmetrise, transpose
from visfuse_cli.records import Array, Gaussian, GroundMap

Z95 = 1.959963984540054
ANGLE_Q = (0.01, 0.1, 1.0)  # rad^2 s^-3 of a constant velocity of angles: the best of them is the rival
SETTLED_S = 1.0
SLOWEST = 0.12  # m/s
GIVEN_PX, FOUND_PX = 0.5, 1.5  # that the box of a target lies off it, each way


@dataclass(frozen=True, slots=True)
class _Part:
    """What was seen of a target without a break, rows of `SEEN` and `BELIEVED`; beliefs mean (T, 4), cov (T, 4, 4)."""

    seen: NDArray[np.void]
    believed: NDArray[np.void]
    mean: Array
    cov: Array
    log_mu: Array


def conclude(target: Target, ground: GroundMap) -> dict[str, Any] | None:
    """One track of tracks.json; None where it was seen too rarely, or was found unaided and went nowhere."""
    chain = [target]
    while (earlier := chain[-1].earlier) is not None:
        chain.append(earlier)
    parts = [part for each in chain[::-1] if (part := _part(each, ground)) is not None]
    life = target.config.life
    if not parts or sum(np.count_nonzero(_measured(part.seen)) for part in parts) < life.min_frames:
        return None
    whole = _Part(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(_Part)))
    off = np.hypot(*(whole.mean[:, :2] - whole.mean[0, :2]).T)
    far = int(np.argmax(off))  # it may come back
    t = whole.seen["t"]
    if not target.given and (off[far] < life.min_moved or off[far] < SLOWEST * (t[far] - t[0])):
        return None
    summary = _summary(target, whole)
    whole.cov[:, :2, :2] += _of_template(
        target, whole.mean[:, :2]
    )  # not in the speed's doubt: off by the same everywhere
    return {"id": target.id, "summary": summary, "states": _states(target, whole)}


def _measured(seen: NDArray[np.void]) -> NDArray[np.bool_]:
    return np.isfinite(seen["z"][:, 0])


def _part(target: Target, ground: GroundMap) -> _Part | None:
    """What was seen of a target without a break, up to its last measurement; None where that is next to nothing."""
    seen, banks = target.seen[:], target.banks
    measured = np.flatnonzero(_measured(seen))
    if banks is None or len(measured) < 2:
        return None
    seen = seen[: measured[-1] + 1]
    count = len(seen)
    told = target.models.smoothed(banks, seen["t"]) if target.config.smooth else banks.backward(count)
    mean, cov, log_mu = np.empty((count, 4)), np.empty((count, 4, 4)), np.empty((count, len(target.models.names)))
    for k, bank in zip(range(count - 1, -1, -1), told, strict=True):
        one = belief(bank)
        mean[k], cov[k], log_mu[k] = one.mean, one.cov, bank.log_mu
    J = ground_shift(ground, mean[:, :2])
    cov[:, :2, :2] += J @ ground.cov @ transpose(J)
    return _Part(seen, target.believed[:count], mean, cov, log_mu)


def _of_template(target: Target, places: Array) -> Array:
    """What the box's own place on the target adds (T, 2, 2): it stays off as it is and does not average out."""
    reach = np.column_stack([places, np.full(len(places), target.height)]) - target.head.centre
    flat = np.hypot(reach[:, 0], reach[:, 1])
    along = reach[:, :2] / flat[:, None]
    across = along[:, ::-1] * [-1, 1]
    far = np.linalg.norm(reach, axis=1)
    off = (GIVEN_PX if target.given else FOUND_PX) / target.head.lens.K[0, 0] * far  # m, square to the line of sight
    down = off * far / np.abs(reach[:, 2])  # where that meets the ground
    parts = off[:, None] * across, down[:, None] * along
    return np.asarray(sum(part[:, :, None] * part[:, None, :] for part in parts))


def _summary(target: Target, whole: _Part) -> dict[str, Any]:
    t, cov, nis = whole.seen["t"], whole.cov, target.believed[:]["nis"]
    duration = float(t[-1] - t[0])
    distance = float(np.sum(np.hypot(*np.diff(whole.mean[:, :2], axis=0).T)))
    speed = distance / duration
    doubt = float(np.sqrt(np.trace(cov[0, :2, :2]) / 2 + np.trace(cov[-1, :2, :2]) / 2)) / duration
    ahead = prediction_errors(target)
    predicted = {} if ahead is None else {"prediction_rms_2d": ahead[0], "prediction_rms_3d": ahead[1]}
    return {
        "t_start": float(t[0]),
        "t_end": float(t[-1]),
        "n_frames": int(np.count_nonzero(_measured(whole.seen))),
        "distance": distance,
        "speed": speed,
        "speed_ci95": [max(0.0, speed - Z95 * doubt), speed + Z95 * doubt],
        "nis_mean": float(np.nanmean(nis)) if np.isfinite(nis).any() else 0.0,
        "nis_dof": 4,
        "size": target.size.tolist(),
        "ended": target.ended_by,
        **predicted,
    }


def _states(target: Target, whole: _Part) -> Iterator[dict[str, Any]]:
    names, latency = target.models.names, target.config.latency
    columns = whole.seen, whole.believed["ahead"], whole.mean, whole.cov, whole.log_mu
    for seen, ahead, mean, cov, log_mu in zip(*columns, strict=True):
        speed = float(np.hypot(*mean[2:]))
        unit = mean[2:] / max(speed, 1e-6)
        state: dict[str, Any] = {
            "frame": int(seen["frame"]),
            "t": float(seen["t"]),
            "position": mean[:2].tolist(),
            "velocity": mean[2:].tolist(),
            "covariance": symmetrise(cov).tolist(),
            "speed": speed,
            "speed_sigma": float(np.sqrt(max(float(unit @ cov[2:, 2:] @ unit), 0.0))),
            "box": {"left": seen["box"].tolist()} if np.isfinite(seen["box"]).all() else {},
            "measured": bool(np.isfinite(seen["z"][0])),
        }
        if len(names) > 1:
            state["models"] = dict(zip(names, np.exp(log_mu).tolist(), strict=True))
        if np.isfinite(ahead).all():
            state["ahead"] = {"t": float(seen["t"]) + latency, "position": ahead.tolist()}
        yield state


def prediction_errors(target: Target) -> tuple[float, float] | None:
    """RMS (rad) of the direction to the target a latency ahead: told by its angles alone (2D), and by the ground (3D).

    Against the direction in which it was then measured. Bradshaw 1997, sec. 6. None where there is too little of it.
    """
    latency, seen = target.config.latency, target.seen[:]
    seen = seen[: len(target.believed)]
    ahead, seen = target.believed[:]["ahead"][_measured(seen)], seen[_measured(seen)]
    if latency <= 0 or len(seen) < 10:
        return None
    t = seen["t"]
    angles = np.unwrap([_direction(target, z[:2]) for z in seen["z"]], axis=0)  # the ground's axes may lie any way
    used = [i for i in range(len(seen)) if t[i] - t[0] >= SETTLED_S and t[i] + latency <= t[-1]]
    if len(used) < 5:
        return None
    truth = np.column_stack([np.interp(t[used] + latency, t, angles[:, c]) for c in (0, 1)])
    told = np.array([_direction(target, ahead[i]) for i in used])
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
