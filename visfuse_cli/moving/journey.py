"""Where the camera is at any instant, from what the sensors tell: wheels, tachometers, or poses (Jia 2008, sec. 3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths import odometry
from visfuse_cli.maths.kept import Rows
from visfuse_cli.maths.odometry import Poses
from visfuse_cli.moving.head import Head
from visfuse_cli.moving.settings import OdometrySettings
from visfuse_cli.records import Array

POSE = [("frame", int), ("R", float, (3, 3)), ("T", float, 3), ("cov", float, (4, 4))]


class Ride:
    """The camera's way, told by its pose at a time (s); that of every frame that is looked at is kept."""

    def __init__(self, pose: Callable[[float], Poses]) -> None:
        self._pose, self._rows = pose, Rows(POSE)

    def look(self, frame: int, t: float) -> Head:
        """The head at a frame, which comes after all before it."""
        pose = self._pose(t)
        self._rows.append(frame, pose.R[0], pose.T[0], pose.cov[0])
        return Head(t, pose.R[0], pose.T[0])

    def head(self, t: float) -> Head:
        """The head at any time (s)."""
        pose = self._pose(t)
        return Head(t, pose.R[0], pose.T[0])

    def kept(self) -> NDArray[np.void]:
        """A row for every frame looked at: `frame`, `R` (3, 3), `T` (3,) m and `cov` (4, 4) of place and yaw."""
        return np.asarray(self._rows[:])

    def at(self, frames: Array) -> NDArray[np.void]:
        """The rows of some frames (n,) that were looked at."""
        rows = self.kept()
        return rows[np.searchsorted(rows["frame"], frames)]


def journey(form: str, columns: Mapping[str, Array], settings: OdometrySettings) -> Callable[[float], Poses]:
    """The left camera's pose (one of Poses) at a time (s), in its frame at the last sample at or before frame 0.

    form: `pose` (columns x, z, theta and, where given, y, pitch), `wheels` (v1, v2 m/s) or `volts` (u1, u2).
    """
    t = columns["t"]
    origin = max(int(np.searchsorted(t, 1e-9, side="right")) - 1, 0)
    if form == "pose":
        nil = np.zeros_like(t)
        x, y, z, theta, pitch = (columns.get(name, nil) for name in ("x", "y", "z", "theta", "pitch"))
        first = odometry.from_track(t, x, y, z, theta, pitch, t[origin : origin + 1])
        return lambda now: odometry.relative(odometry.from_track(t, x, y, z, theta, pitch, np.array([now])), first)
    share = settings.k_t if form == "volts" else 1.0
    left, right = (share * columns[name] for name in (("u1", "u2") if form == "volts" else ("v1", "v2")))
    drive = odometry.Drive(t, left, right, settings.wheel_separation, (settings.noise_share, settings.noise))
    yaw, offset = settings.camera_yaw, np.array(settings.camera_offset)
    start = drive.camera(np.array([t[origin]]), yaw, offset)
    return lambda now: odometry.relative(drive.camera(np.array([now]), yaw, offset), start)
