"""What a run has found so far: tracks settled, and what each camera added to them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.commands.fuse_cameras.scene import Scene
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.fusing.audit import Finding
from visfuse_cli.fusing.conclude import Path as Settled
from visfuse_cli.fusing.conclude import conclude
from visfuse_cli.fusing.eyes import Eyes
from visfuse_cli.fusing.output import track_record
from visfuse_cli.fusing.person import Person
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array


@dataclass(slots=True)
class Results:
    """What a run has found so far."""

    begun: list[tuple[int, int]] = field(default_factory=list)  # first frame, id
    extent: Array = field(default_factory=lambda: np.zeros((0, 2)))  # corners of where people were, m
    rejected: dict[str, int] = field(default_factory=dict)
    sightings: Array = field(default_factory=lambda: np.zeros(0))  # by camera
    share: Array = field(default_factory=lambda: np.zeros(0))  # of what was measured, summed over sets and people
    square: Array = field(default_factory=lambda: np.zeros(0))  # px^2, of the reprojection, summed
    findings: list[Finding] = field(default_factory=list)


def settle(
    ended: list[Person], eyes: Eyes, scene: Scene, config: FuseConfig, run_: Run, spool: TrackSpool, results: Results
) -> None:
    """Turn whom nobody follows any more into records."""
    for person in ended:
        path: Settled | None = conclude(person, eyes.P, config)
        if path is None:
            reason = person.ended_by if not person.confirmed else "too short"
            results.rejected[reason] = results.rejected.get(reason, 0) + 1
            run_.count("rejected")
            continue
        path = replace(path, residual=path.residual * eyes.zoom[:, None])
        spool.add(track_record(path, scene.names, scene.R, scene.t))
        results.begun.append((int(path.frame[path.told][0]), path.id))
        _contribute(path, results)
        places = np.concatenate([results.extent, path.belief.mean[:, :2]])
        results.extent = np.stack([places.min(axis=0), places.max(axis=0)])
        run_.count("people")


def _contribute(path: Settled, results: Results) -> None:
    """Count what each camera added to a path."""
    seen, square = path.seen.sum(axis=0), np.nansum(np.sum(path.residual**2, axis=2), axis=0)
    if not len(results.sightings):
        results.sightings, results.share, results.square = 0.0 * seen, 0.0 * square, 0.0 * square
    results.sightings = results.sightings + seen
    results.share = results.share + path.weight.sum(axis=0)
    results.square = results.square + square


def summary_of(scene: Scene, offsets: dict[str, float], run_: Run, results: Results, folder: Path) -> dict[str, Any]:
    return {
        "per_camera": _per_camera(scene, results),
        "offsets": offsets,
        "people": len(results.begun),
        "rejected": results.rejected,
        "sets_of_frames": run_.counts["sets of frames"],
        "cameras": scene.names,
        "out": str(folder),
    }


def _per_camera(scene: Scene, results: Results) -> dict[str, dict[str, Any]]:
    """What each camera added, and how it fits the others."""
    total = float(results.share.sum()) if len(results.share) else 0.0
    told: dict[str, dict[str, Any]] = {}
    for c, (name, found) in enumerate(zip(scene.names, results.findings, strict=True)):
        n = float(results.sightings[c]) if len(results.sightings) else 0.0
        told[name] = {
            "sightings": int(n),
            "share": float(results.share[c]) / total if total else 0.0,
            "reprojection_px": float(np.sqrt(results.square[c] / n)) if n else None,
            "shift_px": found.shift.tolist(),
            "late_s": found.late,
            "unused": found.unused,
        }
    return told
