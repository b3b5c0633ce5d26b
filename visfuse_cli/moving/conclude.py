"""What a finished track was: its states given the whole recording, with what is not known of the camera's own way."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import imm
from visfuse_cli.maths.gaussian import symmetrise, transpose
from visfuse_cli.moving.journey import Ride
from visfuse_cli.moving.models import P, V
from visfuse_cli.moving.target import VIEWS, Target
from visfuse_cli.records import Array, Gaussian, StereoRig

FEWEST = 2  # measurements that make a part of a track
Z95 = 1.959963984540054
EGO_SHARE = 0.02  # of the camera's way: error of its pose that a static thing may seem to move by
DRIFT_PX = np.array([0.1, 0.1, 0.02])  # of place and disparity: what the same template is off by in every frame
FOUND_PX = np.array([1.5, 1.5, 0.0])  # more of it where the target's box was found, not given
SLOWEST = 0.12  # m/s: what is slower on the whole is not said to move


@dataclass(frozen=True, slots=True)
class Settled:
    """A finished track over T instants, in the world: belief of position and velocity (T, 6), and what was seen."""

    target: Target
    seen: NDArray[np.void]  # rows of `target.SEEN`
    poses: NDArray[np.void]  # rows of `journey.POSE`
    belief: Gaussian
    log_mu: Array  # (T, r)
    nis: Array  # of each measurement but the first

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Whether the target was seen."""
        return np.isfinite(self.seen["nis"])


def conclude(target: Target, ride: Ride) -> Settled | None:
    """Settle a track; None where it was measured too rarely, or was found unaided and stands still.

    What was seen of the target before it was away or lost comes first.
    """
    chain = [target]
    while (earlier := chain[-1].earlier) is not None:
        chain.append(earlier)
    parts = [part for each in chain[::-1] if (part := _part(each, ride)) is not None]
    if not parts:
        return None
    settled = _joined(parts)
    if np.count_nonzero(settled.measured) < target.config.life.min_frames:
        return None
    return settled if target.given or _moved(settled) else None


def _part(target: Target, ride: Ride) -> Settled | None:
    """What was seen of a target without a break; None where that is next to nothing."""
    seen = target.seen[:]
    measured = np.flatnonzero(np.isfinite(seen["nis"]))
    if len(measured) < FEWEST:
        return None
    seen = seen[: measured[-1] + 1]
    banks, count = target.banks, len(seen)
    told = target.models.smoothed(banks, seen["t"]) if target.config.smooth else banks.backward(count)
    mean, cov, log_mu = np.empty((count, 6)), np.empty((count, 6, 6)), np.empty((count, len(target.models.names)))
    for k, bank in zip(range(count - 1, -1, -1), told, strict=True):
        belief = imm.combined(bank)
        mean[k], cov[k], log_mu[k] = belief.mean[:6], belief.cov[:6, :6], bank.log_mu
    poses = ride.at(seen["frame"])
    cov += _of_pose(mean, poses) + _of_template(target.rig, mean, poses, DRIFT_PX)
    return Settled(target, seen, poses, Gaussian(mean, cov), log_mu, seen["nis"][measured[1:]])


def _joined(parts: Sequence[Settled]) -> Settled:
    """The parts of one track, one after another."""
    belief = Gaussian(*(np.concatenate([getattr(part.belief, name) for part in parts]) for name in ("mean", "cov")))
    seen, poses, log_mu, nis = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("seen", "poses", "log_mu", "nis")
    )
    return Settled(parts[-1].target, seen, poses, belief, log_mu, nis)


def _of_pose(mean: Array, poses: NDArray[np.void]) -> Array:
    """What the camera's own doubt adds (T, 6, 6): its place, and its turning times the distance."""
    added = np.zeros((len(mean), 6, 6))
    reach = mean[:, :3] - poses["T"]
    turn = np.stack([-reach[:, 2], 0 * reach[:, 0], reach[:, 0]], axis=1)  # d position / d theta
    J = np.concatenate([np.tile(np.eye(3), (len(mean), 1, 1)), turn[:, :, None]], axis=2)
    added[:, :3, :3] = J @ poses["cov"] @ transpose(J)
    return added


def _of_template(rig: StereoRig, mean: Array, poses: NDArray[np.void], off: Array) -> Array:
    """What the template's own place in the target adds (T, 6, 6), off by (3,) px of place and disparity.

    It stays off as it is and does not average out.
    """
    added = np.zeros((len(mean), 6, 6))
    fx, fy = np.diag(rig.left.K)[:2]
    x, y, z = np.moveaxis((mean[:, None, :3] - poses["T"][:, None]) @ poses["R"], -1, 0)[..., 0]
    J = np.zeros((len(mean), 3, 3))  # of the place in the camera's frame by u, v and disparity
    J[:, 0, 0], J[:, 1, 1] = z / fx, z / fy
    J[:, :, 2] = -np.stack([x, y, z], axis=1) * (z / (fx * rig.baseline))[:, None]
    J = poses["R"] @ J * off
    added[:, :3, :3] = J @ transpose(J)
    return added


def _moved(settled: Settled) -> bool:
    """Whether a target found unaided went anywhere in the world, beyond what the camera's pose may be off by."""
    place, cov, t = settled.belief.mean[:, :3], settled.belief.cov, settled.seen["t"]
    off = np.linalg.norm(place - place[0], axis=1)
    far = int(np.argmax(off))  # it may come back
    doubt = float(np.sqrt(np.trace(cov[0, :3, :3]) + np.trace(cov[far, :3, :3])))
    least = settled.target.config.life.min_moved + EGO_SHARE * settled.target.away + 2 * doubt
    return bool(off[far] > least and off[far] / max(float(t[far] - t[0]), 1e-6) > SLOWEST)


def track_record(path: Settled) -> dict[str, Any]:
    """One track of tracks.json; its states are made as they are written."""
    mean, cov, t = path.belief.mean, path.belief.cov, path.seen["t"]
    duration = float(t[-1] - t[0])
    distance = float(np.sum(np.linalg.norm(np.diff(mean[:, P], axis=0), axis=1))) if len(t) > 1 else 0.0
    mean_speed = distance / duration if duration > 0 else 0.0
    doubt = float(np.sqrt(np.trace(cov[0, P, P]) / 3 + np.trace(cov[-1, P, P]) / 3)) / duration if duration > 0 else 0.0
    return {
        "id": path.target.id,
        "summary": {
            "t_start": float(t[0]),
            "t_end": float(t[-1]),
            "n_frames": int(np.count_nonzero(path.measured)),
            "distance": distance,
            "speed": mean_speed,
            "speed_ci95": [max(0.0, mean_speed - Z95 * doubt), mean_speed + Z95 * doubt],
            "nis_mean": float(np.mean(path.nis)) if len(path.nis) else 0.0,
            "nis_dof": 5,
            "size": path.target.size.tolist(),
            "ended": path.target.ended_by,
        },
        "states": _states(path),
    }


def _states(path: Settled) -> Iterator[dict[str, Any]]:
    target, mean, cov = path.target, path.belief.mean, path.belief.cov
    if not target.given:  # no part of the speed's doubt: the box is off by the same everywhere
        cov = cov + _of_template(target.rig, mean, path.poses, FOUND_PX)
    rows = zip(path.seen, mean, cov, path.log_mu, strict=True)
    return (_state(target, *row) for row in rows)


def _state(target: Target, seen: np.void, mean: Array, cov: Array, log_mu: Array) -> dict[str, Any]:
    names, latency = target.models.names, target.config.latency
    speed = float(np.linalg.norm(mean[V]))
    unit = mean[V] / max(speed, 1e-6)
    state: dict[str, Any] = {
        "frame": int(seen["frame"]),
        "t": float(seen["t"]),
        "position": mean[P].tolist(),
        "velocity": mean[V].tolist(),
        "covariance": symmetrise(cov).tolist(),
        "speed": speed,
        "speed_sigma": float(np.sqrt(max(float(unit @ cov[V, V] @ unit), 0.0))),
        "box": {view: seen[view].tolist() for view in VIEWS if np.isfinite(seen[view]).all()},
        "measured": bool(np.isfinite(seen["nis"])),
    }
    if len(names) > 1:
        state["models"] = dict(zip(names, np.exp(log_mu).tolist(), strict=True))
    if np.isfinite(seen["ahead"]).all():
        state["ahead"] = {"t": float(seen["t"] + latency), "position": seen["ahead"].tolist()}
    return state
