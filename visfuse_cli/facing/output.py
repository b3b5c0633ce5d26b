"""A settled track as the record that leaves the program."""

from __future__ import annotations

from typing import Any

import numpy as np

from visfuse_cli.facing.conclude import Z95, Settled
from visfuse_cli.records import Array, Lens, StereoRig
from visfuse_cli.vision.lens import distort_points


def shown(quad: Array, lens: Lens) -> Array:
    """A quad (4, 2) of undistorted pixels as the footage shows it."""
    return distort_points(quad, lens) if np.any(lens.D) else quad


def track_record(path: Settled, rig: StereoRig, latency: float) -> dict[str, Any]:
    """One track of tracks.json."""
    mean, cov = path.belief.mean, path.belief.cov
    lenses = {"left": rig.left, "right": rig.right}
    low = max(0.0, path.mean_speed - Z95 * path.mean_sigma)
    ahead = mean[:, :3] + latency * mean[:, 3:]
    return {
        "id": path.id,
        "summary": {
            "t_start": float(path.t[0]),
            "t_end": float(path.t[-1]),
            "n_frames": int(np.count_nonzero(path.measured)),
            "distance": path.distance,
            "speed": path.mean_speed,
            "speed_ci95": [low, path.mean_speed + Z95 * path.mean_sigma],
            "noise": path.noise,
            "nis_mean": float(np.mean(path.nis)) if path.nis else 0.0,
            "nis_dof": path.nis_dof,
            "relief": path.relief,
            "sigma_v": path.sigma_v,
            "path": {"from": path.way.frame(np.array(0.0))[0].tolist(), "length": path.way.length},
            "ended": path.ended_by,
        },
        "states": [
            {
                "frame": path.frame[k],
                "t": float(path.t[k]),
                "position": mean[k, :3].tolist(),
                "velocity": mean[k, 3:].tolist(),
                "covariance": cov[k].tolist(),
                "speed": float(path.speed[k]),
                "speed_sigma": float(path.speed_sigma[k]),
                "box": {view: _box(shown(quad, lenses[view])) for view, quad in path.quads[k].items()},
                "quad": {view: shown(quad, lenses[view]).tolist() for view, quad in path.quads[k].items()},
                "measured": bool(path.measured[k]),
            }
            | ({"ahead": {"t": float(path.t[k] + latency), "position": ahead[k].tolist()}} if latency else {})
            for k in range(len(path.t))
        ],
    }


def _box(quad: Array) -> list[float]:
    low, high = quad.min(axis=0), quad.max(axis=0)
    return [*low.tolist(), *(high - low).tolist()]
