"""What the time stamps of a clip say about its recording: frames dropped, irregular, duplicated, lost."""

from __future__ import annotations

from array import array

import numpy as np

from visfuse_cli.records import Array, TimeAudit

IRREGULAR = 0.2  # of the nominal interval
GAP = 1.5  # nominal intervals; longer than this, a frame is missing


class TimeAuditor:
    """Collects the stamps (8 bytes each) and the losses of one reading of a clip."""

    def __init__(self, name: str, resolution_s: float = 0.0) -> None:
        self.name = name
        self.resolution_s = resolution_s  # stamps are rounded to this by the container
        self.duplicated = 0
        self.lost = 0
        self.decode_errors = 0
        self._lost_inside = 0
        self.warnings: list[str] = []
        self._stamps = array("d")

    def add(self, t: float) -> None:
        """Note one frame's time (s)."""
        self._stamps.append(t)

    def lose(self, frames: int, inside: bool) -> None:
        """Note frames that could not be decoded; those lost inside the clip also leave a gap in the stamps."""
        self.lost += frames
        self._lost_inside += frames if inside else 0

    def warn(self, text: str) -> None:
        """Note what else is wrong with the clip."""
        self.warnings.append(f"{self.name}: {text}")

    def result(self) -> TimeAudit:
        """The audit of what was read so far."""
        stamps = np.array(self._stamps)
        intervals = np.diff(stamps)
        nominal = _nominal(intervals, self.resolution_s)
        slack = IRREGULAR * nominal + self.resolution_s
        multiples = np.round(intervals / nominal) if nominal else intervals
        gaps = np.zeros(len(intervals), bool)
        # Where most intervals differ there is no beat that a frame could be missing from (variable frame rate).
        if np.count_nonzero(np.abs(intervals - nominal) <= slack) * 2 > len(intervals):
            late = np.append(intervals[1:] < nominal - slack, False)  # the next one makes up for it: nothing is missing
            gaps = (intervals > GAP * nominal + self.resolution_s) & ~late[: len(intervals)]
        dropped = max(int(np.sum(multiples[gaps] - 1)) - self._lost_inside, 0)
        explained = gaps & (np.abs(intervals - multiples * nominal) <= slack)
        irregular = int(np.count_nonzero((np.abs(intervals - nominal) > slack) & ~explained))
        return TimeAudit(
            frames=len(stamps),
            duration_s=float(stamps[-1] - stamps[0]) if len(stamps) else 0.0,
            nominal_interval_s=nominal,
            dropped=dropped,
            irregular=irregular,
            duplicated=self.duplicated,
            lost=self.lost,
            warnings=(*self.warnings, *self._findings(stamps, gaps, dropped, irregular)),
        )

    def _findings(self, stamps: Array, gaps: np.ndarray, dropped: int, irregular: int) -> list[str]:
        found = []
        if dropped:
            first = float(stamps[int(np.argmax(gaps))])
            found.append(f"{plural(dropped, 'frame')} missing in gaps of the time stamps, first at {first:.3f} s")
        if irregular:
            found.append(f"{irregular} of {len(stamps) - 1} intervals off the usual one by more than a fifth")
        if self.duplicated:
            found.append(f"{plural(self.duplicated, 'frame')} repeated (equal stamp, or equal in every pixel)")
        if self.lost:
            found.append(f"{plural(self.lost, 'frame')} lost: the file is truncated or damaged")
        return [f"{self.name}: {text}" for text in found]


def plural(n: int, noun: str) -> str:
    """A count and its noun."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _nominal(intervals: Array, resolution_s: float) -> float:
    """The usual interval (s): the mean of those near the median, which rounding of the stamps does not bias."""
    if not len(intervals):
        return 0.0
    median = float(np.median(intervals))
    near = intervals[np.abs(intervals - median) <= IRREGULAR * median + resolution_s]
    return float(near.mean()) if len(near) else median
