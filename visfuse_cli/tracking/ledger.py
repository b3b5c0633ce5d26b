"""The ledger of a run: every track that ended as a record and a row, accepted or rejected, with its lane in the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from visfuse_cli.maths.cameras import project
from visfuse_cli.maths.polygons import Polygon
from visfuse_cli.records import Array, GroundCamera
from visfuse_cli.tracking.conclude import Path, conclude
from visfuse_cli.tracking.dynamics import Dynamics
from visfuse_cli.tracking.headlights import REASON
from visfuse_cli.tracking.lanes import Way, find_lanes, lane_of, thinned
from visfuse_cli.tracking.options import SpeedOptions
from visfuse_cli.tracking.output import abandoned_row, row_of, track_record
from visfuse_cli.tracking.places import Places
from visfuse_cli.tracking.targets import Abandoned, Track
from visfuse_cli.tracking.verdict import judge
from visfuse_cli.tracking.zones import Region, trusted

SEEN_FRAMES = 8  # a region seen for fewer frames than this is noise and not worth a line in the ledger


@dataclass(frozen=True, slots=True)
class Recording:
    """What the ledger needs to know of a clip: its name, the name that tracks carry, and when it began."""

    name: str
    label: str | None
    camera: GroundCamera
    began: datetime | None
    image_from_rest: Callable[[int], Array | None]  # where the camera looked in a frame


@dataclass(frozen=True, slots=True)
class Taken:
    """A track's record for tracks.json, and the earlier tracks that are rejected for its sake, with the reason."""

    record: dict[str, Any]
    displaced: list[int]
    reason: str


class Ledger:
    """Rows of accepted and rejected tracks over all clips of a run; what is kept of a track is small."""

    def __init__(self, config: SpeedOptions) -> None:
        self.rows: list[dict[str, Any]] = []
        self.rejected: list[dict[str, Any]] = []
        self.drawn: dict[str, list[tuple[int, int]]] = {}  # clip -> (first frame, id)
        self._config = config
        self._region = Region(np.array(config.region)) if config.region else None
        self._speeds: dict[int, float] = {}  # of accepted tracks, m/s
        self._ways: dict[int, Way] = {}  # track -> where it drove while it was measured
        self._places: dict[str, Places] = {}  # of each clip

    @property
    def speeds(self) -> list[float]:
        """Of the accepted tracks, m/s."""
        return list(self._speeds.values())

    def take(
        self,
        tracks: Sequence[Track],
        of: Recording,
        dynamics: Dynamics,
        only_light: Callable[[int], bool],
        fall: Array | None,
    ) -> Iterator[Taken]:
        """Conclude and judge tracks; but those that never were in the region come out.

        `only_light` tells of an id whether no more than lamps was seen of it; shadows fall `fall` (2,) m for a metre of
        height, where that is known.
        """
        for whole in conclude(tracks, of.camera, self._config, dynamics, fall):
            taken = self._judged(whole, of, only_light(whole.id))
            if taken is not None:
                yield taken

    def _judged(self, whole: Path, of: Recording, only_light: bool) -> Taken | None:
        config, camera = self._config, of.camera
        path = whole if self._region is None else self._region.part(whole)
        if path is None:
            return None
        position = path.planar.mean[:, :2]
        zone = trusted(camera, position, config.pose.bias_px, config.speed.max_calibration)
        verdict = judge(path, camera.ground.cov, config.pose.bias_px, config.speed, zone)
        if only_light:
            verdict = replace(verdict, reason=REASON)
        displaced: list[int] = []
        if not verdict.reason:
            better, displaced = self._places.setdefault(of.name, Places()).take(path, verdict)
            verdict = verdict if better is None else replace(verdict, reason=_in_place_of(better))
        self.drawn.setdefault(of.name, []).append((int(path.frame[0]), path.id))
        self._ways[path.id] = thinned(position[verdict.first : verdict.last + 1])
        row = row_of(path, verdict, of.name, utc(of.began, path.t[verdict.first]))
        (self.rejected if verdict.reason else self.rows).append(row)
        if not verdict.reason:
            self._speeds[path.id] = verdict.speed
        reason = _in_place_of(path.id)
        self._displace(displaced, reason)
        record = track_record(path, verdict, camera, of.label, of.image_from_rest, config.latency)
        return Taken(record, displaced, reason)

    def forget(self, of: Recording, before: int) -> None:
        """What is not finished yet was not seen before a frame of a clip."""
        if of.name in self._places:
            self._places[of.name].forget(before)

    def _displace(self, identities: list[int], reason: str) -> None:
        """Reject accepted tracks for what was found later."""
        for row in [row for row in self.rows if row["track_id"] in identities]:
            self.rows.remove(row)
            self.rejected.append(row | {"reason": reason})
            del self._speeds[row["track_id"]]

    def give_up(self, candidate: Abandoned, of: Recording) -> None:
        """Note what never became a track, unless it was noise or outside of the region."""
        place = candidate.position
        inside = place is not None and (self._region is None or bool(self._region.holds(np.array(place))))
        if inside and candidate.n_frames >= SEEN_FRAMES:
            self.rejected.append(abandoned_row(candidate, of.name, utc(of.began, candidate.t_start)))

    def found_lanes(self, camera: GroundCamera) -> tuple[Polygon, ...]:
        """Lanes from where the vehicles of all clips drove, if that is asked for and there were enough of them."""
        if not self._config.lane_finding.find or self._config.target.motion != "bicycle":
            return ()

        def image_of(ground: Array) -> Array:
            return project(camera, np.column_stack([ground, np.zeros(len(ground))]))[0]

        return find_lanes([self._ways[row["track_id"]] for row in self.rows], self._config.lane_finding, image_of)

    def give_lanes(self, lanes: Sequence[Polygon]) -> None:
        """Tell each track its lane."""
        for row in (*self.rows, *self.rejected):
            if row["track_id"] in self._ways:
                row["lane"] = lane_of(self._ways[row["track_id"]], lanes)


def _in_place_of(identity: int) -> str:
    return f"in the place of track {identity}, for which more speaks"


def utc(began: datetime | None, t: float) -> str:
    """The time of day (ISO 8601, Z) t s after a recording began; empty where nobody knows."""
    if began is None:
        return ""
    moment = (began + timedelta(seconds=float(t))).astimezone(UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
