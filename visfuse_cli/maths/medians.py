"""The median, for those who ask many times a frame."""

from __future__ import annotations

import numpy as np

from visfuse_cli.records import Array


def median(values: Array) -> float:
    """The median of a few values (n,), in a fraction of the time that numpy takes for all of its cases."""
    ordered = np.sort(values)
    return float(ordered[(len(values) - 1) // 2] + ordered[len(values) // 2]) / 2
