"""Lanes: polygons on the ground, given or found once from where vehicles drive, and who used which."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from visfuse_cli.config import Section
from visfuse_cli.maths.polygons import Polygon, contains
from visfuse_cli.records import Array

MOSTLY = 0.6  # of the way that a vehicle makes in lanes: the lane that holds as much of it is the vehicle's
SAMPLES = 24  # places kept of one vehicle's way
ALIKE_RAD = np.radians(25)  # courses that differ by less run in one carriageway
SPREAD_M = 0.45  # how far vehicles of one lane drive from its middle
VALLEY = 0.7  # of the lower of two peaks: where fewer drive between them, they are two lanes
STEP_M = 3.0  # between the corners of a lane's border
ENDS = 0.08  # share of the ways that may begin or end outside of a lane's length
GRID_M = 0.05  # at which the density across the road is looked at


class LaneSettings(Section):
    """How lanes are found where none are given."""

    find: bool = Field(True, description="find lanes from where vehicles drive, when neither lanes nor lanes_file has")
    vehicles: int = Field(8, ge=2, le=100000, description="vehicles from which lanes are found, all lanes together")
    least_vehicles: int = Field(3, ge=2, le=1000, description="vehicles that make a lane")
    width: float = Field(3.5, gt=0.5, le=10, description="m: width of a lane without a neighbour, and at most")


@dataclass(frozen=True, slots=True)
class Way:
    """Where one vehicle drove while it was measured: position (k, 2) m, at least two."""

    position: Array

    @property
    def course(self) -> Array:
        """Unit vector (2,) from its beginning to its end."""
        along = self.position[-1] - self.position[0]
        return np.asarray(along / max(float(np.hypot(*along)), 1e-9))


def thinned(position: Array) -> Way:
    """A way as it is kept until all vehicles are known, from positions (T, 2) m."""
    kept = np.unique(np.linspace(0, len(position) - 1, min(len(position), SAMPLES)).round().astype(int))
    return Way(position[kept])


def lane_of(way: Way, lanes: Sequence[Polygon]) -> int | None:
    """The number (from 1) of the lane that holds most of what a vehicle drove in lanes at all.

    None where it kept to none: outside of all lanes, or on the line between two of them.
    """
    if not lanes:
        return None
    ends = way.position
    dense = np.concatenate([ends, (ends[1:] + ends[:-1]) / 2])
    inside = np.stack([contains(np.array(lane), dense) for lane in lanes])
    inside[1:] &= ~np.logical_or.accumulate(inside, axis=0)[:-1]  # where lanes overlap the first one counts
    held = inside.sum(axis=1)
    best = int(np.argmax(held))
    return best + 1 if held[best] >= MOSTLY * held.sum() and held[best] else None


def find_lanes(ways: Sequence[Way], settings: LaneSettings, image_of: Callable[[Array], Array]) -> tuple[Polygon, ...]:
    """Lanes from where vehicles drove, numbered from the left of the picture; none where too few drove.

    `image_of` leads from ground points (n, 2) m to pixels (n, 2). Ways of one course make a carriageway; across it
    vehicles gather about the middles of its lanes.
    """
    found: list[Array] = []
    if len(ways) < settings.vehicles:
        return ()
    for group in _carriageways([way for way in ways if len(way.position) > 1]):
        if len(group) >= settings.least_vehicles:
            found += _across(group, settings)
    found.sort(key=lambda polygon: float(np.nanmean(image_of(polygon)[:, 0])))
    return tuple(tuple((round(float(x), 2), round(float(y), 2)) for x, y in polygon) for polygon in found)


def _carriageways(ways: Sequence[Way]) -> list[list[Way]]:
    """Ways by their course: each group about the course that most of those left agree with."""
    left, groups = list(ways), []
    while left:
        courses = np.array([way.course for way in left])
        agree = courses @ courses.T > np.cos(ALIKE_RAD)
        best = agree[int(np.argmax(agree.sum(axis=1)))]
        groups.append([way for way, chosen in zip(left, best, strict=True) if chosen])
        left = [way for way, chosen in zip(left, best, strict=True) if not chosen]
    return groups


def _across(ways: list[Way], settings: LaneSettings) -> list[Array]:
    """The lanes (k, 2) m of one carriageway."""
    along = np.median([way.course for way in ways], axis=0)
    along /= np.hypot(*along)
    axes = np.stack([along, [-along[1], along[0]]])  # along, and to its left
    local = [way.position @ axes.T for way in ways]
    curve = _curve(local)
    offset = np.array([np.median(part[:, 1] - curve(part[:, 0])) for part in local])
    middles, group = _middles(offset, settings)
    lanes = []
    for number, middle in enumerate(middles):
        mine = [part for part, chosen in zip(local, group, strict=True) if chosen == number]
        begin = float(np.quantile([part[:, 0].min() for part in mine], ENDS))
        end = float(np.quantile([part[:, 0].max() for part in mine], 1 - ENDS))
        aside = np.abs(np.delete(middles, number) - middle)
        half = min(settings.width, float(aside.min()) if len(aside) else np.inf) / 2
        stations = np.linspace(begin, end, max(2, round((end - begin) / STEP_M) + 1))
        line = curve(stations) + middle
        border = np.concatenate(
            [np.column_stack([stations, line - half]), np.column_stack([stations, line + half])[::-1]]
        )
        lanes.append(border @ axes)
    return lanes


def _curve(local: list[Array]) -> Callable[[Array], Array]:
    """How the carriageway bends: a parabola through all ways, each free to lie aside by its own constant."""
    x = np.concatenate([part[:, 0] for part in local])
    middle, scale = float(x.mean()), max(float(np.ptp(x)) / 2, 1.0)
    basis = lambda s: np.stack([(s - middle) / scale, ((s - middle) / scale) ** 2], axis=-1)  # noqa: E731
    rows, values = [], []
    for part in local:
        shape = basis(part[:, 0])
        rows.append(shape - shape.mean(axis=0))
        values.append(part[:, 1] - part[:, 1].mean())
    bend = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    return lambda s: np.asarray(basis(s) @ bend)


def _middles(offset: Array, settings: LaneSettings) -> tuple[Array, NDArray[np.intp]]:
    """Middles (k,) m of the lanes from where each of n vehicles drove across the road, and whose lane each was; -1: no
    one's."""
    grid = np.arange(offset.min() - 2, offset.max() + 2, GRID_M)
    density = np.exp(-(((grid[:, None] - offset) / SPREAD_M) ** 2) / 2).sum(axis=1)
    inner = density[1:-1]
    peaks = 1 + np.flatnonzero((inner > density[:-2]) & (inner >= density[2:]))
    kept = [int(peaks[0])] if len(peaks) else []
    for peak in peaks[1:]:
        valley = float(density[kept[-1] : peak].min())
        if valley < VALLEY * min(density[kept[-1]], density[peak]):
            kept.append(int(peak))
        elif density[peak] > density[kept[-1]]:
            kept[-1] = int(peak)
    group = np.argmin(np.abs(offset[:, None] - grid[kept]), axis=1)
    group[np.abs(offset - grid[kept][group]) > settings.width / 2] = -1
    count = np.array([np.sum(group == k) for k in range(len(kept))])
    real = np.flatnonzero(count >= settings.least_vehicles)
    middles = np.array([np.median(offset[group == k]) for k in real])
    number = {int(k): n for n, k in enumerate(real)}
    return middles, np.array([number.get(int(k), -1) for k in group])
