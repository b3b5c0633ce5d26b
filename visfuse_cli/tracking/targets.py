"""What the tracker holds of each thing it follows."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from visfuse_cli.records import Array
from visfuse_cli.tracking.dynamics import Step
from visfuse_cli.tracking.settings import SizePrior
from visfuse_cli.vision.contour import Look
from visfuse_cli.vision.wireframe import Outlines

REVERSES = 6.0  # m/s: what goes backwards faster is something else, which came the other way


@dataclass(slots=True)
class Sample:
    """One frame of a target: its outline, and shares of what nothing hides (NaN: all is hidden).

    border: of the border that could be found, what was; apart, paint and shaded as in `Look`.
    """

    frame: int
    t: float
    outline: Outlines
    border: float
    measured: bool
    apart: float = 1.0
    paint: float = 1.0
    shaded: float = 0.0

    @classmethod
    def of(cls, frame: int, t: float, look: Look, k: int, border: Array, measured: bool) -> Sample:
        """The k-th of the boxes that were looked for, border (N,) of each found."""
        shares = (float(share[k]) for share in (look.apart, look.paint, look.shaded))
        return cls(frame, t, look.outlines[k], float(border[k]), measured, *shares)


def velocity_at_start(samples: list[Sample], pose: Array) -> Array:
    """Velocity (2,) m/s over the first second of a path (n, 3)."""
    end = max(1, sum(sample.t - samples[0].t < 1.0 for sample in samples) - 1)
    return np.asarray((pose[end, :2] - pose[0, :2]) / (samples[end].t - samples[0].t))


@dataclass(slots=True)
class Comparison:
    """When (s) a track's box is to be compared with others again, where (2,) m it last was, and the wait (s) after."""

    due: float = -np.inf
    place: Array = field(default_factory=lambda: np.full(2, np.inf))
    wait: float = 1.0


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
    slip: float = 0.0  # deviations by which the corners on it are faster than its box, lately
    slips: bool = False  # whether the box is left behind by them
    compared: Comparison = field(default_factory=Comparison)  # with other boxes
    refused: int = 0  # measurements that fell outside the gate
    refused_since: float | None = None  # s: since when all of them did
    ended_by: str = ""
    traced_from: int = 0  # the frame back to which it was followed when it was found


@dataclass(frozen=True, slots=True)
class Abandoned:
    """A region given up before it became a track, for the rejection ledger."""

    t_start: float
    t_end: float
    n_frames: int
    position: tuple[float, float] | None
    reason: str
