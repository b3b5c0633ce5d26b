"""Whether a filter's innovations are as large as it says."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from scipy.stats import chi2

BAND = 0.999  # probability inside the bands


def verdict(ratio: float, freedom: float) -> dict[str, Any]:
    """A mean normalised square per degree of freedom, against its chi-square band over `freedom` degrees."""
    low, high = (float(chi2.ppf(p, freedom)) / freedom for p in ((1 - BAND) / 2, (1 + BAND) / 2))
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


def _told(summary: Mapping[str, Any]) -> tuple[float, float] | None:
    """Innovation squared per degree of freedom, and the degrees of freedom, of one track."""
    if summary.get("nis_mean") and summary.get("nis_dof"):
        return summary["nis_mean"] / summary["nis_dof"], summary["nis_dof"] * summary["n_frames"]
    if summary.get("nis_per_dof"):
        return summary["nis_per_dof"], summary["n_frames"]
    return None
