"""What is held of each person that is followed."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np

from visfuse_cli.fusing.body import Body
from visfuse_cli.maths.fusion_rivals import Bank
from visfuse_cli.records import Array, Gaussian, Sighting

Z, VARIANCE, BOX, DT = slice(0, 2), slice(2, 5), slice(5, 9), 9  # columns of History.rows
LEVER, ASSUMED = slice(10, 13), 13
COLUMNS = 14


class History:
    """What was seen of one person, frame by frame, in few bytes: a row for each camera, NaN where it saw nothing."""

    def __init__(self, cameras: int) -> None:
        self._cameras = cameras
        self.frame = array("q")
        self.t = array("d")
        self._state = array("d")
        self._rows = array("d")
        self.denied = array("b")  # cameras with a clear sight of the place that did not see it

    def __len__(self) -> int:
        return len(self.t)

    def add(self, frame: int, t: float, state: Array, sightings: dict[int, Sighting]) -> None:
        """Keep one instant: position and velocity (6,) as then believed, and the sightings by camera."""
        rows = np.full((self._cameras, COLUMNS), np.nan)
        for camera, sight in sightings.items():
            rows[camera, Z], rows[camera, BOX], rows[camera, DT] = sight.z, sight.box, sight.dt
            rows[camera, VARIANCE] = sight.R[0, 0], sight.R[0, 1], sight.R[1, 1]
            rows[camera, LEVER], rows[camera, ASSUMED] = sight.lever, sight.assumed
        self.frame.append(frame)
        self.t.append(t)
        self.denied.append(0)
        self._state.extend(state)
        self._rows.extend(rows.ravel())

    @property
    def state(self) -> Array:
        """Position and velocity (T, 6) as believed at the time."""
        return np.array(self._state, dtype=float).reshape(-1, 6)

    @property
    def rows(self) -> Array:
        """Sightings (T, C, COLUMNS)."""
        return np.array(self._rows, dtype=float).reshape(-1, self._cameras, COLUMNS)

    def delay(self, late: Array) -> None:
        """Say of each camera's sightings that they were made later than was thought, by `late` (C,) s."""
        np.frombuffer(self._rows).reshape(-1, self._cameras, COLUMNS)[:, :, DT] += late

    def forget(self, cameras: list[int]) -> None:
        """Take back what cameras saw that are not to be believed."""
        if cameras:
            np.frombuffer(self._rows).reshape(-1, self._cameras, COLUMNS)[:, cameras] = np.nan

    def cut(self, length: int) -> None:
        """Forget what came after the first `length` instants."""
        del self.frame[length:], self.t[length:], self.denied[length:], self._state[6 * length :]
        del self._rows[length * self._cameras * COLUMNS :]


@dataclass(slots=True)
class Person:
    """A person followed: the belief of position and velocity (6,), body, looks, and what was seen so far."""

    id: int
    belief: Gaussian
    start: Gaussian
    body: Body
    history: History
    t: float
    last_seen: float
    bank: Bank | None = None
    seen_frames: int = 0  # instants at which two cameras or more saw it
    first_seen: float = 0.0
    last_pair: float = 0.0  # s: when two cameras or more last saw it
    missed: int = 0  # times that a camera did not see it where nothing hid it, since it was last seen
    refused: int = 0
    refused_since: float | None = None
    confirmed: bool = False
    ended_by: str = ""
    cameras: set[int] = field(default_factory=set)
    last: dict[int, Sighting] = field(default_factory=dict)
