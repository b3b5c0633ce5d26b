"""Angles on the circle."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from visfuse_cli.records import Array


def wrap(angle: ArrayLike) -> Array:
    """Angle (...) rad brought to (-pi, pi]."""
    # The half turn itself stays positive, so that one direction has one name.
    return np.pi - np.mod(np.pi - np.asarray(angle, dtype=float), 2 * np.pi)


def wrap_at(vector: Array, angles: tuple[int, ...]) -> Array:
    """A copy of vectors (..., n) whose components listed in `angles` are brought to (-pi, pi]."""
    if not angles:
        return vector
    wrapped = vector.copy()
    for k in angles:
        wrapped[..., k] = wrap(vector[..., k])
    return wrapped
