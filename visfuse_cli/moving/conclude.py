"""What a finished track was: its states given the whole recording, with what is not known of the camera's own way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from visfuse_cli.maths import imm
from visfuse_cli.moving.models import P, V
from visfuse_cli.moving.target import Target
from visfuse_cli.records import Array, Gaussian, StereoRig

FEWEST = 2  # measurements that make a part of a track
Z95 = 1.959963984540054
EGO_SHARE = 0.02  # of the camera's way: error of its pose that a static thing may seem to move by
DRIFT_PX = np.array([0.1, 0.1, 0.02])  # of place and disparity: what the same template is off by in every frame
SLOWEST = 0.12  # m/s: what is slower on the whole is not said to move


@dataclass(frozen=True, slots=True)
class Settled:
    """A finished track over T instants, in the world: belief of position and velocity (T, 6), and what was seen."""

    id: int
    frame: list[int]
    t: Array
    belief: Gaussian
    log_mu: Array  # (T, r)
    names: tuple[str, ...]
    boxes: list[dict[str, Array]]
    measured: Array
    ahead: list[Gaussian | None]
    nis: Array  # of each measurement but the first
    size: Array
    ended_by: str


def conclude(target: Target, pose_cov: Callable[[int], Array]) -> Settled | None:
    """Settle a track; None where it was measured too rarely, or was found unaided and stands still.

    pose_cov tells the covariance (4, 4) of the camera's position and yaw at a frame. What was seen of the target before
    it was away or lost comes first.
    """
    chain = [target]
    while (earlier := chain[-1].earlier) is not None:
        chain.append(earlier)
    parts = [part for each in chain[::-1] if (part := _part(each, pose_cov)) is not None]
    if not parts:
        return None
    first, *others = parts
    for other in others:
        first = _joined(first, other)
    if np.count_nonzero(first.measured) < target.config.life.min_frames:
        return None
    return first if target.given or _moved(target, first) else None


def _part(target: Target, pose_cov: Callable[[int], Array]) -> Settled | None:
    """What was seen of a target without a break; None where that is next to nothing."""
    measured = np.array([seen.measured for seen in target.history])
    if np.count_nonzero(measured) < FEWEST:
        return None
    last = int(np.flatnonzero(measured)[-1]) + 1
    history, measured = target.history[:last], measured[:last]
    t = np.array([seen.t for seen in history])
    if target.config.smooth:
        banks = target.models.smoothed([seen.step for seen in history], t)
    else:
        banks = [seen.step.filtered for seen in history]
    common = [imm.combined(bank) for bank in banks]
    mean = np.stack([belief.mean for belief in common])[:, :6]
    cov = np.stack([belief.cov for belief in common])[:, :6, :6]
    of_pose = _of_pose(mean, np.stack([pose_cov(seen.frame) for seen in history]), history)
    return Settled(
        id=target.id,
        frame=[seen.frame for seen in history],
        t=t,
        belief=Gaussian(mean, cov + of_pose + _of_template(target.rig, mean, history)),
        log_mu=np.stack([bank.log_mu for bank in banks]),
        names=target.models.names,
        boxes=[seen.boxes for seen in history],
        measured=measured,
        ahead=[seen.ahead for seen in history],
        nis=np.array([seen.nis for seen in history])[measured][1:],
        size=target.size,
        ended_by=target.ended_by,
    )


def _joined(first: Settled, then: Settled) -> Settled:
    """Two parts of one track."""
    keep = int(np.searchsorted(first.frame, then.frame[0]))  # it was still predicted as it was found again
    belief = Gaussian(
        np.concatenate([first.belief.mean[:keep], then.belief.mean]),
        np.concatenate([first.belief.cov[:keep], then.belief.cov]),
    )
    return replace(
        then,
        frame=first.frame[:keep] + then.frame,
        t=np.concatenate([first.t[:keep], then.t]),
        belief=belief,
        log_mu=np.concatenate([first.log_mu[:keep], then.log_mu]),
        boxes=first.boxes[:keep] + then.boxes,
        measured=np.concatenate([first.measured[:keep], then.measured]),
        ahead=first.ahead[:keep] + then.ahead,
        nis=np.concatenate([first.nis, then.nis]),
    )


def _of_pose(mean: Array, pose_cov: Array, history: list[Any]) -> Array:
    """What the camera's own doubt adds (T, 6, 6): its place, and its turning times the distance."""
    added = np.zeros((len(mean), 6, 6))
    reach = mean[:, :3] - np.stack([seen.head.T for seen in history])
    turn = np.stack([-reach[:, 2], 0 * reach[:, 0], reach[:, 0]], axis=1)  # d position / d theta
    J = np.concatenate([np.tile(np.eye(3), (len(mean), 1, 1)), turn[:, :, None]], axis=2)
    added[:, :3, :3] = J @ pose_cov @ np.swapaxes(J, 1, 2)
    return added


def _of_template(rig: StereoRig, mean: Array, history: list[Any]) -> Array:
    """What the template's own place in the target adds (T, 6, 6): it stays off as it is and does not average out."""
    added = np.zeros((len(mean), 6, 6))
    fx, fy = np.diag(rig.left.K)[:2]
    for k, seen in enumerate(history):
        x, y, z = seen.head.inside(mean[k, :3])
        J = np.array(
            [
                [z / fx, 0, -x * z / (fx * rig.baseline)],
                [0, z / fy, -y * z / (fx * rig.baseline)],
                [0, 0, -(z**2) / (fx * rig.baseline)],
            ]
        )
        J = seen.head.R @ J * DRIFT_PX
        added[k, :3, :3] = J @ J.T
    return added


def _moved(target: Target, settled: Settled) -> bool:
    """Whether a target found unaided went anywhere in the world, beyond what the camera's pose may be off by."""
    place, cov = settled.belief.mean[:, :3], settled.belief.cov
    off = np.linalg.norm(place - place[0], axis=1)
    far = int(np.argmax(off))  # it may come back
    doubt = float(np.sqrt(np.trace(cov[0, :3, :3]) + np.trace(cov[far, :3, :3])))
    least = target.config.life.min_moved + EGO_SHARE * target.away + 2 * doubt
    return bool(off[far] > least and off[far] / max(float(settled.t[far] - settled.t[0]), 1e-6) > SLOWEST)


def track_record(path: Settled, latency: float) -> dict[str, Any]:
    """One track of tracks.json."""
    mean, cov = path.belief.mean, path.belief.cov
    speed = np.linalg.norm(mean[:, V], axis=1)
    unit = mean[:, V] / np.maximum(speed, 1e-6)[:, None]
    sigma = np.sqrt(np.clip(np.einsum("ti,tij,tj->t", unit, cov[:, V, V], unit), 0, None))
    duration = float(path.t[-1] - path.t[0])
    distance = float(np.sum(np.linalg.norm(np.diff(mean[:, P], axis=0), axis=1))) if len(path.t) > 1 else 0.0
    mean_speed = distance / duration if duration > 0 else 0.0
    doubt = float(np.sqrt(np.trace(cov[0, P, P]) / 3 + np.trace(cov[-1, P, P]) / 3)) / duration if duration > 0 else 0.0
    states = []
    for k in range(len(path.t)):
        state: dict[str, Any] = {
            "frame": path.frame[k],
            "t": float(path.t[k]),
            "position": mean[k, P].tolist(),
            "velocity": mean[k, V].tolist(),
            "covariance": ((cov[k] + cov[k].T) / 2).tolist(),
            "speed": float(speed[k]),
            "speed_sigma": float(sigma[k]),
            "box": {view: box.tolist() for view, box in path.boxes[k].items()},
            "measured": bool(path.measured[k]),
        }
        if len(path.names) > 1:
            state["models"] = dict(zip(path.names, np.exp(path.log_mu[k]).tolist(), strict=True))
        later = path.ahead[k]
        if later is not None:
            state["ahead"] = {"t": float(path.t[k] + latency), "position": later.mean[P].tolist()}
        states.append(state)
    return {
        "id": path.id,
        "summary": {
            "t_start": float(path.t[0]),
            "t_end": float(path.t[-1]),
            "n_frames": int(np.count_nonzero(path.measured)),
            "distance": distance,
            "speed": mean_speed,
            "speed_ci95": [max(0.0, mean_speed - Z95 * doubt), mean_speed + Z95 * doubt],
            "nis_mean": float(np.mean(path.nis)) if len(path.nis) else 0.0,
            "nis_dof": 5,
            "size": path.size.tolist(),
            "ended": path.ended_by,
        },
        "states": states,
    }
