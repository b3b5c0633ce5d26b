"""Upright boxes [x, y, w, h] px."""

from __future__ import annotations

import numpy as np

from visfuse_cli.records import Array


def box_of(quad: Array) -> Array:
    """The box (4,) around a quad (4, 2)."""
    low, top = quad.min(axis=0), quad.max(axis=0)
    return np.concatenate([low, top - low])


def covered(box: Array, other: Array) -> float:
    """The share of a box (4,) that another one covers."""
    low, top = np.maximum(box[:2], other[:2]), np.minimum(box[:2] + box[2:], other[:2] + other[2:])
    return float(np.prod(np.clip(top - low, 0, None)) / max(float(np.prod(box[2:])), 1e-9))
