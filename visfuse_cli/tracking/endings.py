"""Why tracks end."""

from __future__ import annotations

import numpy as np

from visfuse_cli.maths.cameras import ground_scale, project
from visfuse_cli.records import Array, Boxes, GroundCamera
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking.association import footprint_overlap
from visfuse_cli.tracking.dynamics import Dynamics
from visfuse_cli.tracking.hypotheses import LEAST_OPEN
from visfuse_cli.tracking.settings import LifeSettings
from visfuse_cli.tracking.targets import Track
from visfuse_cli.tracking.zones import Region
from visfuse_cli.vision import wireframe

UNLIKE = 0.5  # share of its border found lately, below which a track is no longer like itself
ONE_PLACE = 0.4  # of a footprint in another's: one of the two is wrong


def reasons(
    tracks: list[Track],
    boxes: Boxes,
    camera: GroundCamera,
    dynamics: Dynamics,
    life: LifeSettings,
    region: Region | None,
    t: float,
) -> list[str]:
    """Why each track, with its box as last known, ends at t (s); empty where it lives on."""
    outside, scale = _out_of_picture(camera, *boxes), _scale(camera, boxes[0])
    twins = _twins(tracks, *boxes)
    found = []
    for k, track in enumerate(tracks):
        if k in twins:
            same = _lived_together(track, twins[k], dynamics)
            found.append(f"same vehicle as track {twins[k].id}" if same else "lost")
        elif outside[k]:
            found.append("left the picture")
        elif region is not None and _left(track, region):
            found.append("left the region")
        elif scale[k] > life.max_scale:
            found.append("left the measurable zone")
        elif track.likeness < UNLIKE:
            found.append("no longer looks like itself")
        elif track.refused_since is not None and t - track.refused_since > life.max_refused_s:
            found.append("jumped")
        else:
            found.append("lost" if t - track.last_measured > life.max_coast_s else "")
    return found


def trimmed(track: Track, reason: str) -> Track:
    """The track, ended for a reason, without the predictions after its last measurement."""
    while len(track.samples) > 1 and not track.samples[-1].measured:
        track.samples.pop()
        track.steps.pop()
    track.ended_by = reason
    return track


def _out_of_picture(camera: GroundCamera, pose: Array, size: Array) -> np.ndarray:
    pixels = wireframe.projected(camera, pose, size)
    low, high = pixels.min(axis=2).T, pixels.max(axis=2).T
    inside = np.clip(np.minimum(high, camera.image_size) - np.maximum(low, 0), 0, None)
    return np.asarray(~(np.prod(inside, axis=1) > LEAST_OPEN * np.prod(high - low, axis=1)))


def _scale(camera: GroundCamera, pose: Array) -> Array:
    """Metres of ground (N,) under a pixel where N boxes stand."""
    feet, _ = project(camera, np.column_stack([pose[:, :2], np.zeros(len(pose))]))
    return ground_scale(camera, feet)


def _left(track: Track, region: Region) -> bool:
    """Whether a track has just left the region, or is nowhere near it."""
    places = np.array([step.posterior.mean[:2] for step in track.steps[-2:]])
    inside = region.holds(places)
    return not inside[-1] and bool(inside[0] or not region.near(places[-1]))


def _twins(tracks: list[Track], pose: Array, size: Array) -> dict[int, Track]:
    """The tracks (by number) in whose place another one stands that looks more like a vehicle, and that one."""
    apart = np.hypot(*(pose[:, None, :2] - pose[None, :, :2]).T)
    reach = np.hypot(*size[:, :2].T) / 2
    if np.count_nonzero(apart < reach[:, None] + reach) == len(tracks):  # nobody is near anybody else
        return {}
    shared = footprint_overlap(pose, size, pose, size) > ONE_PLACE
    worth = [(round(track.likeness, 1), len(track.samples)) for track in tracks]
    found: dict[int, Track] = {}
    for k in np.argsort([-len(track.samples) for track in tracks]):
        for other in np.flatnonzero(shared[k]):
            if other != k and int(other) not in found and worth[other] > worth[k]:
                found[int(k)] = tracks[other]
    return found


def _lived_together(track: Track, other: Track, dynamics: Dynamics) -> bool:
    """Whether a track was in the other's place for most of its life; else it was hidden there in the end."""
    index = {sample.frame: k for k, sample in enumerate(other.samples)}
    common = [(k, index[sample.frame]) for k, sample in enumerate(track.samples) if sample.frame in index]
    (pose, size), (place, its) = (
        (
            np.array([dynamics_tools.pose(dynamics, each.steps[k].posterior.mean) for k in rows]),
            np.tile(each.size, (len(rows), 1)),
        )
        for each, rows in zip((track, other), zip(*common, strict=True), strict=True)
    )
    shared = np.diagonal(footprint_overlap(pose, size, place, its)) > ONE_PLACE
    return bool(np.count_nonzero(shared) > len(track.samples) / 2)
