"""How far a run's states and speeds are from the truth, and whether that is what they say of themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from scipy.stats import chi2

from visfuse_cli.evaluate import plots
from visfuse_cli.evaluate.agreement import Z95
from visfuse_cli.evaluate.matching import Rows
from visfuse_cli.evaluate.tables import Estimates, Table
from visfuse_cli.maths.consistency import verdict
from visfuse_cli.records import Array

WHOLE = 0.8  # of a stretch whose truth is known, to compare mean speeds


def of_states(
    run: Estimates, axes: Array, place: Array, velocity: Array, pairs: Rows
) -> tuple[dict[str, Any], list[Any]]:
    """Errors of position, velocity and speed, how many intervals hold the truth, and the verdicts; with drawings."""
    mine, true = pairs.T
    size, dims = axes.shape
    off = run.position[mine] @ axes.T - place[true]
    both = np.kron(np.eye(2), axes)
    cov = both @ run.covariance[mine] @ both.T
    nees = _mahalanobis(off, cov[:, :size, :size])
    tracks = len(np.unique(run.id[mine]))
    inside = nees <= chi2.ppf(0.95, size)
    result: dict[str, Any] = {"position_m": _statistics(np.linalg.norm(off, axis=1), off, inside)}
    moving = np.isfinite(velocity[true]).all(axis=1)
    speeds = None
    if moving.any():
        m, t = mine[moving], true[moving]
        apart = run.velocity[m] @ axes.T - velocity[t]
        speed = np.linalg.norm(velocity[t], axis=1)
        own = run.speed[m] if size == dims else np.linalg.norm(run.velocity[m] @ axes.T, axis=1)
        faster = own - speed
        held = np.abs(faster) <= Z95 * run.speed_sigma[m]
        speeds = (speed, own)
        result["velocity_m_s"] = _statistics(np.linalg.norm(apart, axis=1), apart)
        result["speed_m_s"] = _statistics(np.abs(faster), faster)
        result["speed_interval_coverage"] = float(held.mean())
        whole = _mahalanobis(np.concatenate([off[moving], apart], axis=1), cov[moving])
        # The errors of one track go together: each track is one draw, not each of its states.
        result["nees_with_velocity"] = verdict(float(whole.mean()) / (2 * size), 2.0 * size * tracks)
    result["nees"] = verdict(float(nees.mean()) / size, float(size * tracks))
    drawings = [plots.errors(run.frame[mine], np.linalg.norm(off, axis=1), run.id[mine]), plots.normalised(nees, size)]
    return result, drawings + ([plots.speeds(*speeds)] if speeds else [])


def _mahalanobis(off: Array, cov: Array) -> Array:
    """Squared normalised errors (n,), on the directions that a covariance says anything of."""
    return np.asarray(np.einsum("ni,nij,nj->n", off, np.linalg.pinv(cov, rcond=1e-12, hermitian=True), off))


def _statistics(sizes: Array, signed: Array, inside: NDArray[np.bool_] | None = None) -> dict[str, Any]:
    found: dict[str, Any] = {
        "rmse": float(np.sqrt(np.mean(sizes**2))),
        "median": float(np.median(sizes)),
        "max": float(sizes.max()),
        "bias": signed.mean(axis=0).tolist(),
    }
    return found if inside is None else found | {"coverage_95": float(np.mean(inside))}


def of_mean_speeds(run: Estimates, truth: Table, pairs: Rows) -> dict[str, Any]:
    """Each track's summary speed beside the true mean speed over the same stretch, where that is known."""
    if "t" not in truth.columns:
        return {}
    v = truth.stack(("vx", "vy", "vz"))
    speed = np.sqrt(np.nansum(v**2, axis=1))
    t, off, inside = truth.columns["t"], [], []
    for track in run.tracks:
        mine = (run.id[pairs[:, 0]] == track["id"]) & (run.clip[pairs[:, 0]] == str(track.get("clip", "")))
        if not mine.any():
            continue
        who, count = np.unique(truth.columns["id"][pairs[mine, 1]], return_counts=True)
        summary = track["summary"]
        first, last = summary["t_start"], summary["t_end"]
        rows = np.flatnonzero((truth.columns["id"] == who[np.argmax(count)]) & (t >= first - 1e-6) & (t <= last + 1e-6))
        rows = rows[np.isfinite(v[rows, 0]) & (truth.clip[rows] == truth.clip[pairs[mine, 1][0]])]
        rows = rows[np.argsort(t[rows])]
        if len(rows) < 2 or t[rows[-1]] - t[rows[0]] < WHOLE * (last - first):
            continue
        mean = trapezoid(speed[rows], t[rows]) / (t[rows[-1]] - t[rows[0]])
        low, high = summary.get("speed_ci95") or (np.nan, np.nan)
        off.append(summary["speed"] - mean)
        inside.append(low <= mean <= high)
    if not off:
        return {}
    values = np.array(off)
    return {"mean_speed_m_s": {"tracks": len(off)} | _statistics(np.abs(values), values, np.array(inside))}
