"""Surveyed points, lines or gaze angles, the homography through them, and what to doubt about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from visfuse_cli.commands.calibrate_homography.settings import CalibrateConfig
from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.calibration_input import read_gaze, read_lines, read_points
from visfuse_cli.maths import gaze
from visfuse_cli.maths.calibration_error import speed_error
from visfuse_cli.maths.homography_fit import Fit, fit_points
from visfuse_cli.maths.lines import fit_lines
from visfuse_cli.records import Array, GroundMap, Image, Lens
from visfuse_cli.vision.lens import distort_points, undistort_points
from visfuse_cli.vision.line_tracing import snap

Size = tuple[int, int]
FEW = 6  # below, leaving one out says more about the others' places than about its own
FAR = 3e4  # the survey's distance from the world's origin, in its own extents, before double precision runs out


@dataclass(frozen=True, slots=True)
class Survey:
    """What was surveyed (marks (N, 2 or 4) in the image, world (N, 2 or 4) m) and the homography through it."""

    noun: str
    marks: Array
    world: Array
    fit: Fit
    warnings: tuple[str, ...] = ()
    input: str = "pixel"


def read(options: dict[str, Any], config: CalibrateConfig, image: Image | None, lens: Lens | None) -> Survey:
    """The homography through what the options name, points, lines or gaze angles; raises InputError, UsageError."""
    if options.get("gaze"):
        return _from_gaze(options["gaze"], config)
    if options.get("lines"):
        return _from_lines(options["lines"], config, image, lens)
    path: Path = options["points"]
    return from_points(*read_points(path), config, lens, path)


def from_points(marks: Array, world: Array, config: CalibrateConfig, lens: Lens | None, path: Path) -> Survey:
    """The homography through points (N, 2) px and (N, 2) m; raises InputError that names `path`."""
    straight = _straightened(path, marks, lens)
    return Survey("point", marks, world, _named(path, lambda: fit_points(straight, world, *_fitting(config))))


def from_lines(marks: Array, world: Array, config: CalibrateConfig, lens: Lens | None, path: Path) -> Survey:
    """The homography through lines (N, 4) px and (N, 4) m; raises InputError that names `path`."""
    straight = _straightened(path, marks.reshape(-1, 2), lens).reshape(-1, 4)
    return Survey("line", marks, world, _named(path, lambda: fit_lines(straight, world, *_fitting(config))))


def _from_lines(path: Path, config: CalibrateConfig, image: Image | None, lens: Lens | None) -> Survey:
    marks, world = read_lines(path)
    warnings: tuple[str, ...] = ()
    if config.snap.enabled:
        if image is None:
            raise UsageError("snap.enabled needs --image: lines are moved onto the edges of a picture")
        marks, snapped = snap(image, marks, config.snap.radius_px)
        warnings = tuple(f"line {k + 1} has no edge under it and stays as drawn" for k in np.flatnonzero(~snapped))
    return replace(from_lines(marks, world, config, lens, path), warnings=warnings)


def _from_gaze(path: Path, config: CalibrateConfig) -> Survey:
    angles, world = read_gaze(path)
    marks = gaze.frontal(angles[:, 0], angles[:, 1], config.gaze.order)
    robust = config.robust.threshold_rad if config.robust.enabled else None

    def measured(points: Array) -> Array:
        return np.column_stack(gaze.angles(points, config.gaze.order))

    def fit() -> Fit:
        return fit_points(marks, world, config.noise.sigma_rad, robust, config.limits.condition, measured)

    return Survey("point", marks, world, _named(path, fit), input="gaze")


def _straightened(path: Path, marks: Array, lens: Lens | None) -> Array:
    """Pixels (N, 2) without the lens's distortion; raises InputError where the lens model cannot be undone."""
    if lens is None:
        return marks
    straight = undistort_points(marks, lens)
    off = np.linalg.norm(distort_points(straight, lens) - marks, axis=1)
    for k in np.flatnonzero(~(off < 0.1)):
        u, v = marks[k]
        raise InputError(f"{path}: the lens's distortion cannot be undone at pixel ({u:g}, {v:g}); wrong --camera?")
    return straight


def _fitting(config: CalibrateConfig) -> tuple[float, float | None, float]:
    robust = config.robust.threshold_px if config.robust.enabled else None
    return config.noise.sigma_px, robust, config.limits.condition


def _named(path: Path, fit: Callable[[], Fit]) -> Fit:
    """Run a fit; its refusal names the file."""
    try:
        return fit()
    except InputError as problem:
        raise InputError(f"{path}: {problem}") from problem
    except np.linalg.LinAlgError as problem:
        raise InputError(f"{path}: this input does not determine a homography ({problem})") from problem


def doubts(survey: Survey, size: Size | None, config: CalibrateConfig) -> list[str]:
    """What a person should know before trusting this calibration."""
    noun, fit, found = survey.noun, survey.fit, list[str]()
    for k in map(int, np.flatnonzero(~fit.used)):
        found.append(
            f"{noun} {k + 1} disagrees with the others by {fit.error_m[k]:.1f} m on the ground and was dropped"
        )
    if fit.used.sum() < FEW:
        found.append(f"{int(fit.used.sum())} {noun}s leave little to check them with; six or more are better")
    for k in map(int, np.flatnonzero(fit.leave_one_out_m > config.limits.leave_one_out_m)):
        found.append(
            f"leaving out {noun} {k + 1} moves it by {fit.leave_one_out_m[k]:.1f} m: the calibration hangs on it"
        )
    ground = survey.world.reshape(-1, 2)
    far, extent = float(np.abs(ground).max()), float(np.ptp(ground, axis=0).max())
    if far > FAR * extent:
        found.append(
            f"the ground points lie {far / 1000:.0f} km from their origin, too far for the covariance's digits; "
            "subtract a constant from X and Y"
        )
    if size is not None and survey.input == "pixel":
        for k, mark in enumerate(survey.marks):
            ends = mark.reshape(-1, 2)
            if np.any((ends < -0.5) | (ends > np.array(size) - 0.5)):
                found.append(f"{noun} {k + 1} lies outside the {size[0]}x{size[1]} image")
    return found


def residuals(fit: Fit) -> tuple[dict[str, Any], ...]:
    """What H.json says of each mark."""
    return tuple(
        {
            "index": k,
            "error_m": _finite(fit.error_m[k]),
            "error_px": _finite(fit.error_px[k]),
            "leave_one_out_m": _finite(fit.leave_one_out_m[k]),
            "used": bool(fit.used[k]),
        }
        for k in range(len(fit.used))
    )


def speed_sigma(survey: Survey, ground: GroundMap, config: CalibrateConfig) -> float | None:
    """Standard deviation (km/h) to expect of 50 km/h over one second in the middle of the survey."""
    marks = survey.marks[survey.fit.used].reshape(-1, 2).mean(axis=0, keepdims=True)
    centre = marks if ground.lens is None else undistort_points(marks, ground.lens)
    return _finite(speed_error(ground, centre, config.noise.sigma_px)[0])


def _finite(value: float) -> float | None:
    """A number for JSON: None where it is not finite."""
    return float(value) if np.isfinite(value) else None
