"""Footage that is boxes alone: instants without pictures, at a stated rate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from visfuse_cli.files.timing import TimeAuditor
from visfuse_cli.records import Image


@dataclass(frozen=True, slots=True)
class _Nothing:
    raw: Image

    def bgr(self) -> Image:
        return np.zeros((0, 0, 3), np.uint8)


class BoxTimes:
    """`count` instants at `fps`, for a camera whose footage is not there; size (w, h) px."""

    creation_time: datetime | None = None
    resolution_s = 0.0

    def __init__(self, count: int, fps: float, size: tuple[int, int]) -> None:
        self.announced: int | None = count
        self.nominal_rate = fps
        self.width, self.height = size
        self._count = count

    def pictures(self, auditor: TimeAuditor, start: float) -> Iterator[tuple[int, float, _Nothing]]:
        """Every instant at or after `start` (s)."""
        for index in range(self._count):
            if index / self.nominal_rate >= start:
                yield index, index / self.nominal_rate, _Nothing(np.array([index], np.int64).view(np.uint8))
