"""A settled path as the record that leaves the program, in the calibration's world."""

from __future__ import annotations

from typing import Any

import numpy as np

from visfuse_cli.fusing.conclude import Path
from visfuse_cli.records import Array, Gaussian

Z95 = 1.959963984540054


def in_world(belief: Gaussian, R: Array, t: Array) -> Gaussian:
    """Beliefs (T, 6) from the ground's frame, x_ground = R x_world + t, back to the world."""
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = R.T
    shift = np.concatenate([t, np.zeros(3)])
    return Gaussian((belief.mean - shift) @ both.T, both @ belief.cov @ both.T)


def track_record(path: Path, names: list[str], R: Array, t: Array) -> dict[str, Any]:
    """One track of tracks.json; names of the cameras in their order, and x_ground = R x_world + t."""
    world = in_world(path.belief, R, t)
    velocity, cov = world.mean[:, 3:], world.cov
    speed = np.linalg.norm(velocity, axis=1)
    unit = velocity / np.maximum(speed, 1e-6)[:, None]
    sigma = np.sqrt(np.clip(np.einsum("ti,tij,tj->t", unit, cov[:, 3:, 3:], unit), 0, None))
    return {
        "id": path.id,
        "class": "person",
        "summary": _summary(path, names),
        "states": [
            {
                "frame": int(path.frame[k]),
                "t": float(path.t[k]),
                "position": world.mean[k, :3].tolist(),
                "velocity": velocity[k].tolist(),
                "covariance": cov[k].tolist(),
                "speed": float(speed[k]),
                "speed_sigma": float(sigma[k]),
                "box": {names[c]: path.boxes[k, c].tolist() for c in np.flatnonzero(path.seen[k])},
                "measured": bool(path.seen[k].any()),
            }
            for k in np.flatnonzero(path.told)
        ],
    }


def _summary(path: Path, names: list[str]) -> dict[str, Any]:
    ground, cov = path.belief.mean[:, :2], path.belief.cov
    duration = float(path.t[-1] - path.t[0])
    distance = float(np.sum(np.linalg.norm(np.diff(ground, axis=0), axis=1)))
    mean = distance / duration if duration > 0 else 0.0
    doubt = np.sqrt(np.trace(cov[0, :2, :2]) / 2 + np.trace(cov[-1, :2, :2]) / 2) / duration if duration > 0 else 0.0
    doubt = float(np.hypot(doubt, _wiggle(path.belief.mean[:, 3:5], cov[:, 3:5, 3:5])))
    used = path.seen.any(axis=1)
    error = np.sqrt(np.nanmean(np.sum(path.residual**2, axis=2))) if path.seen.any() else None
    return {
        "t_start": float(path.t[0]),
        "t_end": float(path.t[-1]),
        "n_frames": int(np.count_nonzero(used)),
        "distance": distance,
        "speed": mean,
        "speed_ci95": [max(0.0, mean - Z95 * doubt), mean + Z95 * doubt],
        "height": path.height,
        "reprojection_px": None if error is None else float(error),
        "cameras": {name: int(np.count_nonzero(path.seen[:, c])) for c, name in enumerate(names)},
        "nis_mean": float(path.nis.mean()) if len(path.nis) else None,
        "nis_dof": 3,
        "noise": path.noise,
        "sigma_a": path.sigma_a,
        "ended": path.ended_by,
    }


def _wiggle(velocity: Array, cov: Array) -> float:
    """The speed (m/s) that errors across the path add to its length by wiggles, or take from it by rounded corners.

    velocity (T, 2) m/s along the ground, cov (T, 2, 2): a velocity off by d across is longer by d^2 / 2 v; as much
    again for corners.
    """
    speed = np.linalg.norm(velocity, axis=1)
    unit = velocity / np.maximum(speed, 1e-6)[:, None]
    across = np.trace(cov, axis1=1, axis2=2) - np.einsum("ti,tij,tj->t", unit, cov, unit)
    sigma = np.sqrt(np.clip(across, 0, None))
    return float(np.mean(np.minimum(sigma**2 / np.maximum(speed, 1e-6), sigma)))
