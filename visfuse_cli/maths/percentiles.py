"""Percentiles of speeds with confidence intervals that assume no distribution, and the pace."""

from __future__ import annotations

import numpy as np
from scipy.special import bdtr

from visfuse_cli.records import Array


def percentile(values: Array, share: float, confidence: float = 0.95) -> tuple[float, float | None, float | None]:
    """The percentile of values (n,) and its interval by order statistics; None where n is too small for an end.

    The number of values below the true percentile is binomial, whatever they are distributed like.
    """
    ordered = np.sort(np.asarray(values, dtype=float))
    tail, count = (1 - confidence) / 2, len(ordered)
    # how sure it is that no more than so many values lie below it
    sure = bdtr(np.arange(count + 1), count, share)
    low, high = (int(np.searchsorted(sure, which)) for which in (tail, 1 - tail))
    high += 1
    return (
        float(np.quantile(ordered, share)),
        float(ordered[low - 1]) if low > 0 else None,
        float(ordered[high - 1]) if high <= count else None,
    )


def pace(speeds: Array, width: float) -> tuple[float, float]:
    """Lower end of the range of this width that holds most speeds (n,), and the share of them in it."""
    ordered = np.sort(np.asarray(speeds, dtype=float))
    held = np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered))
    first = int(np.argmax(held))
    return float(ordered[first]), float(held[first] / len(ordered))
