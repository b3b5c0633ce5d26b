"""A finished path as the records that leave the program: a track, a row of a table."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from visfuse_cli.maths.cameras import project
from visfuse_cli.maths.speed import KMH
from visfuse_cli.records import Array, GroundCamera
from visfuse_cli.tracking.conclude import Path
from visfuse_cli.tracking.targets import Abandoned
from visfuse_cli.tracking.verdict import Z95, Verdict
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.lens import distort_points
from visfuse_cli.vision.steady import moved

COLUMNS = (
    "clip",
    "track_id",
    "t_start",
    "t_end",
    "time_utc",
    "direction",
    "lane",
    "speed_kmh",
    "ci95_low_kmh",
    "ci95_high_kmh",
    "distance_m",
    "n_frames",
)


def box_corners(camera: GroundCamera, pose: Array, size: Array) -> Array:
    """Corners (..., 8, 2) px, in the footage's own pixels, of boxes at pose (..., 3)."""
    pixels, _ = project(camera, wireframe.corners(pose, size))
    if camera.ground.lens is not None:
        pixels = distort_points(pixels.reshape(-1, 2), camera.ground.lens).reshape(pixels.shape)
    return pixels


def track_record(
    path: Path,
    verdict: Verdict,
    camera: GroundCamera,
    clip: str | None,
    image_from_rest: Callable[[int], Array | None],
    latency: float,
) -> dict[str, Any]:
    """One track of tracks.json; `image_from_rest` tells where the camera looked in a frame."""
    mean, cov = path.planar.mean, path.planar.cov
    speed = np.linalg.norm(mean[:, 2:], axis=1)
    unit = mean[:, 2:] / np.maximum(speed, 1e-6)[:, None]
    sigma = np.sqrt(np.clip(np.einsum("ti,tij,tj->t", unit, cov[:, 2:, 2:], unit), 0, None))
    pixels = box_corners(camera, np.column_stack([mean[:, :2], path.heading]), np.tile(path.size, (len(mean), 1)))
    for k, frame in enumerate(path.frame):
        motion = image_from_rest(int(frame))
        if motion is not None:
            pixels[k] = moved(motion, pixels[k])
    low, high = np.nan_to_num(pixels).min(axis=1), np.nan_to_num(pixels).max(axis=1)
    record: dict[str, Any] = {"id": path.id}
    if clip is not None:
        record["clip"] = clip
    record["class"] = path.class_name
    record["summary"] = _summary(path, verdict)
    record["states"] = [
        {
            "frame": int(path.frame[k]),
            "t": float(path.t[k]),
            "position": mean[k, :2].tolist(),
            "velocity": mean[k, 2:].tolist(),
            "covariance": cov[k].tolist(),
            "speed": float(speed[k]),
            "speed_sigma": float(sigma[k]),
            "heading": float(path.heading[k]),
            "box": {"image": [*low[k].tolist(), *(high[k] - low[k]).tolist()]},
            "measured": bool(path.measured[k]),
        }
        for k in range(len(mean))
    ]
    if latency > 0:
        for k, state in enumerate(record["states"]):
            state["ahead"] = {"t": float(path.t[k] + latency), "position": path.ahead[k].tolist()}
    return record


def _summary(path: Path, verdict: Verdict) -> dict[str, Any]:
    nis = path.nis
    return {
        "t_start": float(path.t[verdict.first]),
        "t_end": float(path.t[verdict.last]),
        "n_frames": int(path.measured[verdict.first : verdict.last + 1].sum()),
        "distance": verdict.distance,
        "speed": verdict.speed,
        "speed_ci95": [verdict.speed - Z95 * verdict.sigma, verdict.speed + Z95 * verdict.sigma],
        "direction": _degrees(verdict.course),
        "size": path.size.tolist(),
        "outline_found": path.likeness,
        "outline_support": path.support,
        "nis_mean": float(nis.mean()) if len(nis) else None,
        "noise_scale": path.noise,
        "nis_dof": path.nis_dof,
        "ended": path.ended_by,
        "rejected": verdict.reason or None,
    }


def _degrees(course: float) -> float:
    return float(np.degrees(course) % 360)


def row_of(path: Path, verdict: Verdict, clip: str, time_utc: str) -> dict[str, Any]:
    """One row of speeds.csv (or, with a reason, of rejected.csv); lanes are told when all tracks are known."""
    return {
        "clip": clip,
        "track_id": path.id,
        "t_start": f"{path.t[verdict.first]:.3f}",
        "t_end": f"{path.t[verdict.last]:.3f}",
        "time_utc": time_utc,
        "direction": f"{_degrees(verdict.course):.1f}",
        "lane": "",
        "speed_kmh": f"{verdict.speed * KMH:.2f}",
        "ci95_low_kmh": f"{(verdict.speed - Z95 * verdict.sigma) * KMH:.2f}",
        "ci95_high_kmh": f"{(verdict.speed + Z95 * verdict.sigma) * KMH:.2f}",
        "distance_m": f"{verdict.distance:.2f}",
        "n_frames": int(path.measured[verdict.first : verdict.last + 1].sum()),
    } | ({"reason": verdict.reason} if verdict.reason else {})


def abandoned_row(abandoned: Abandoned, clip: str, time_utc: str) -> dict[str, Any]:
    """A row of rejected.csv for a region that never became a track: it has no id and no speed."""
    empty = dict.fromkeys(COLUMNS, "")
    return empty | {
        "clip": clip,
        "t_start": f"{abandoned.t_start:.3f}",
        "t_end": f"{abandoned.t_end:.3f}",
        "time_utc": time_utc,
        "n_frames": abandoned.n_frames,
        "reason": abandoned.reason,
    }
