"""Whether a filter's innovations are as large as it says."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from scipy.special import chdtri

from visfuse_cli.maths.gaussian import mahalanobis, symmetrise
from visfuse_cli.records import Array, Gaussian

BAND = 0.999  # probability inside the bands
FULL_RANK = 1e-6  # share of the largest eigenvalue, above rounding


def verdict(ratio: float, freedom: float) -> dict[str, Any]:
    """A mean normalised square per degree of freedom, against its chi-square band over `freedom` degrees."""
    low, high = (float(chdtri(freedom, above)) / freedom for above in ((1 + BAND) / 2, (1 - BAND) / 2))
    word = "consistent" if low <= ratio <= high else ("cautious" if ratio < low else "too sure of itself")
    return {"per_degree_of_freedom": ratio, "band": [low, high], "verdict": word}


def innovations(summaries: Iterable[Mapping[str, Any]]) -> dict[str, Any] | None:
    """The verdict on the normalised innovations of all tracks together, None where none tells them."""
    told = [_told(summary) for summary in summaries]
    table = np.array([row for row in told if row is not None], dtype=float).reshape(-1, 2)
    if not len(table):
        return None
    ratio, freedom = table.T
    return verdict(float(ratio @ freedom / freedom.sum()), float(freedom.sum()))


def corrections(prior: Gaussian, posterior: Gaussian, size: int) -> Array:
    """Normalised squares (k,), chi-square of `size`, of what measurements moved the first numbers of beliefs (T, n).

    A Kalman filter's correction K g has the covariance K S K^T: the prior's less the posterior's. Instants whose
    measurement did not tell all `size` numbers are left out.
    """
    moved = (posterior.mean - prior.mean)[:, :size]
    spread = symmetrise(prior.cov - posterior.cov)[:, :size, :size]
    values = np.linalg.eigvalsh(spread)
    whole = values[:, 0] > FULL_RANK * np.maximum(values[:, -1], np.finfo(float).tiny)
    return mahalanobis(moved[whole], spread[whole])


def _told(summary: Mapping[str, Any]) -> tuple[float, float] | None:
    """Innovation squared per degree of freedom, and the degrees of freedom, of one track."""
    if summary.get("nis_mean") and summary.get("nis_dof"):
        return summary["nis_mean"] / summary["nis_dof"], summary["nis_dof"] * summary["n_frames"]
    if summary.get("nis_per_dof"):
        return summary["nis_per_dof"], summary["n_frames"]
    return None
