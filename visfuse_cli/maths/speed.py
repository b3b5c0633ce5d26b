"""The mean speed over a stretch of a smoothed track, with the uncertainty of pose, calibration and time stamps."""

from __future__ import annotations

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.records import Array

KMH = 3.6  # km/h in 1 m/s
SAME_COURSE = 0.5  # least length of the sum of two unit tangents (a turn of 151 degrees) that still has a direction


def path_length(positions: Array, tangents: Array) -> float:
    """Length (m) of the whole path; arguments as in `way`."""
    return float(way(positions, tangents)[-1])


def way(positions: Array, tangents: Array) -> Array:
    """Length (T,) m up to each of T >= 1 positions (T, 2) m, with unit tangents (T, 2) of the smoothed velocity.

    Each step counts by its part along the mean tangent, so that sideways noise does not lengthen the path as it does
    a polyline, and lengthwise noise cancels between neighbours; steps are lengthened from chord to arc.
    """
    steps = np.sum(np.diff(positions, axis=0) * _step_tangents(positions, tangents), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def length_gradient(positions: Array, tangents: Array) -> Array:
    """d path_length / d positions (T, 2): the tangent at either end, little between them where the path is straight."""
    steps = _step_tangents(positions, tangents)
    gradient = np.zeros(positions.shape)
    gradient[1:] += steps
    gradient[:-1] -= steps
    return gradient


def end_variance(tangents: Array, first: Array, last: Array, cross: Array | None = None) -> float:
    """Variance (m^2) of the length from the two ends alone; exact on straight paths.

    tangents (T, 2); first, last (2, 2) m^2 covariances of the end positions; cross (2, 2) = cov(first, last), None
    where the ends are independent. On bends use `smoothing.weighted_variance` with `length_gradient`.
    """
    t_0, t_N = tangents[0], tangents[-1]
    shared = 0.0 if cross is None else float(t_0 @ cross @ t_N)
    return max(0.0, float(t_0 @ first @ t_0 + t_N @ last @ t_N) - 2 * shared)


def mean_speed(
    times: Array,
    positions: Array,
    tangents: Array,
    length_variance: float,
    entry_jacobian: Array | None = None,
    entry_cov: Array | None = None,
    sigma_t: float = 0.0,
) -> tuple[float, float, dict[str, float]]:
    """Way along the path by time (m/s), its standard deviation, and that deviation's parts.

    times (T,) s, positions and unit tangents (T, 2) of smoothed states, length_variance (m^2) the pose noise of
    the length, entry_jacobian (T, 2, 9) d position / d homography entries with entry_cov (9, 9), sigma_t (s) the
    noise of one time stamp. Parts in m/s: pose, calibration, time. Raises InputError for a stretch without duration.
    """
    duration = float(times[-1] - times[0]) if len(times) else 0.0
    if not duration > 0:
        raise InputError(f"speed: a stretch needs two states at different times, it has {len(times)} over {duration} s")
    speed = path_length(positions, tangents) / duration
    calibration = 0.0
    if entry_jacobian is not None and entry_cov is not None:
        g = np.einsum("kd,kdh->h", length_gradient(positions, tangents), entry_jacobian)
        calibration = max(0.0, float(g @ entry_cov @ g))
    parts = {
        "pose": float(np.sqrt(length_variance)) / duration,
        "calibration": float(np.sqrt(calibration)) / duration,
        "time": float(np.sqrt(2) * abs(speed) * sigma_t / duration),
    }
    return speed, float(np.sqrt(sum(part**2 for part in parts.values()))), parts


def _step_tangents(positions: Array, tangents: Array) -> Array:
    """Mean tangent (T-1, 2) of each step, as long as the arc is to its chord; the step's own where the course flips."""
    both = tangents[1:] + tangents[:-1]
    norm = np.linalg.norm(both, axis=1, keepdims=True)
    half_turn = np.arccos(np.clip(norm / 2, 0.0, 1.0))
    arc_by_chord = 1 / np.sinc(half_turn / np.pi)
    steps = np.diff(positions, axis=0)
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    own = steps / np.where(length > 0, length, 1.0)
    return np.where(norm > SAME_COURSE, arc_by_chord * both / np.where(norm > 0, norm, 1.0), own)
