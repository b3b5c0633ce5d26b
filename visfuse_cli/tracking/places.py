"""Two vehicles cannot stand in one place: of two finished tracks that did, one is none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from visfuse_cli.records import Array
from visfuse_cli.tracking.association import shared_footprint
from visfuse_cli.tracking.conclude import Path
from visfuse_cli.tracking.verdict import Verdict, evidence

SHARED = 0.15  # of a footprint, in another's: more than boxes err by
OFTEN, LASTING, LEAST_FRAMES = 1 / 3, 0.15, 5  # of the common frames, of the shorter one's frames, and at least


@dataclass(frozen=True, slots=True, eq=False)  # one is itself: arrays are not compared
class Stand:
    """Where a track stood: frames (T,) in which it was measured, pose (T, 3), size (3,), how much speaks for it."""

    id: int
    frame: Array
    pose: Array
    size: Array
    evidence: float

    @classmethod
    def of(cls, path: Path, verdict: Verdict) -> Stand:
        pose = np.column_stack([path.planar.mean[:, :2], path.heading])
        return cls(path.id, path.frame[path.measured], pose[path.measured], path.size, evidence(path, verdict))

    def excludes(self, other: Stand) -> bool:
        """Whether the two stood in one place for so long that one of them is no vehicle."""
        common, mine, its = np.intersect1d(self.frame, other.frame, assume_unique=True, return_indices=True)
        if len(common) < LEAST_FRAMES:
            return False
        there = shared_footprint(self.pose[mine], self.size, other.pose[its], other.size) > SHARED
        shorter = min(len(self.frame), len(other.frame))
        return bool(there.sum() > max(OFTEN * len(common), LASTING * shorter))


class Places:
    """The accepted tracks that stood where one that is not finished may have stood too."""

    def __init__(self) -> None:
        self._stands: list[Stand] = []

    def take(self, path: Path, verdict: Verdict) -> tuple[int | None, list[int]]:
        """The track that keeps this one out, if one does; else those that it pushes out."""
        new = Stand.of(path, verdict)
        rivals = [stand for stand in self._stands if stand.excludes(new)]
        better = max(rivals, key=lambda stand: stand.evidence, default=new)
        if better.evidence > new.evidence:
            return better.id, []
        self._stands = [stand for stand in self._stands if stand not in rivals] + [new]
        return None, [stand.id for stand in rivals]

    def forget(self, before: int) -> None:
        """Nothing that is not finished yet was seen before a frame."""
        self._stands = [stand for stand in self._stands if stand.frame[-1] >= before]
