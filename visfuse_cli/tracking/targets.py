"""What the tracker holds of each thing it follows."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from visfuse_cli.records import Array
from visfuse_cli.tracking.dynamics import Step
from visfuse_cli.tracking.settings import SizePrior
from visfuse_cli.vision.wireframe import Outlines


@dataclass(slots=True)
class Sample:
    """One frame of a target: its outline, the share of its border that was found (NaN: hidden)."""

    frame: int
    t: float
    outline: Outlines
    border: float
    measured: bool


@dataclass(slots=True)
class Comparison:
    """When (s) a track's box is to be compared with others again, where (2,) m it last was, and the wait (s) after."""

    due: float = -np.inf
    place: Array = field(default_factory=lambda: np.full(2, np.inf))
    wait: float = 0.5


@dataclass(slots=True)
class Track:
    """A confirmed target: its samples, one filter step for each, and the belief of its size (m)."""

    id: int
    prior_class: SizePrior
    size: Array
    size_sigma: Array
    samples: list[Sample]
    steps: list[Step]
    last_measured: float
    likeness: float = 1.0  # share of its border that was found lately
    doubt: float = 0.0  # share of its border that was not found or has something moving outside, lately
    compared: Comparison = field(default_factory=Comparison)  # with other boxes
    refused: int = 0  # measurements that fell outside the gate
    refused_since: float | None = None  # s: since when all of them did
    ended_by: str = ""


@dataclass(frozen=True, slots=True)
class Abandoned:
    """A region given up before it became a track, for the rejection ledger."""

    t_start: float
    t_end: float
    n_frames: int
    position: tuple[float, float] | None
    reason: str
