"""`visfuse calibrate-homography`: surveyed points, lines or gaze angles to H.json and a picture that shows its worth.

table -> (undistort, snap) -> fit -> ground map -> H.json, picture, summary
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from pydantic import Field

from visfuse_cli.config import Section
from visfuse_cli.errors import InputError, OutputError, UsageError
from visfuse_cli.files import homography as homography_files
from visfuse_cli.files.atomic import replacing
from visfuse_cli.files.calibration_input import read_gaze, read_lines, read_points
from visfuse_cli.files.lens_files import read_lens
from visfuse_cli.files.video import open_source
from visfuse_cli.maths import gaze
from visfuse_cli.maths.calibration_error import speed_error
from visfuse_cli.maths.homography_fit import Fit, fit_points
from visfuse_cli.maths.lines import fit_lines
from visfuse_cli.records import Array, GroundMap, Image, Lens, RunRequest, RunResult
from visfuse_cli.vision.calibration_picture import draw
from visfuse_cli.vision.lens import undistort_points
from visfuse_cli.vision.line_tracing import snap

Size = tuple[int, int]
FEW = 6  # below, leaving one out says more about the others' places than about its own


class NoiseSettings(Section):
    """How well points were picked; used where there are too few to tell from the residuals."""

    sigma_px: float = Field(1.0, gt=0, le=100, description="px: noise of an image point")
    sigma_rad: float = Field(0.001, gt=0, le=0.5, description="rad: noise of a gaze angle")


class RobustSettings(Section):
    """Leaving out what does not fit."""

    enabled: bool = Field(False, description="drop points that disagree with the rest")
    threshold_px: float = Field(5.0, gt=0, le=1000, description="px: further off than this is dropped")
    threshold_rad: float = Field(0.01, gt=0, le=1, description="rad: the same for gaze angles")


class SnapSettings(Section):
    """Moving roughly drawn lines onto the edges under them; needs --image."""

    enabled: bool = Field(False, description="move lines onto edges of the picture")
    radius_px: float = Field(8.0, gt=0, le=200, description="px: how far a line may move")


class GazeSettings(Section):
    """The pan-tilt head."""

    order: Literal["elevation-vergence", "vergence-elevation"] = Field(
        "elevation-vergence", description="outer axis first"
    )


class LimitSettings(Section):
    """When to warn and when to refuse."""

    condition: float = Field(1e5, gt=1, le=1e15, description="condition number above which the input is refused")
    leave_one_out_m: float = Field(
        1.0, gt=0, le=1e6, description="m: a point that moves further when left out is named"
    )


class CalibrateConfig(Section):
    """Configuration of `visfuse calibrate-homography`."""

    noise: NoiseSettings = NoiseSettings()
    robust: RobustSettings = RobustSettings()
    snap: SnapSettings = SnapSettings()
    gaze: GazeSettings = GazeSettings()
    limits: LimitSettings = LimitSettings()


def run(request: RunRequest) -> RunResult:
    """Fit the homography and write it with its picture; raises InputError for input that cannot carry one."""
    config: CalibrateConfig = request.config
    options = request.options
    picture_path = request.out.with_suffix(".png")
    _check_output(request.out, picture_path if options.get("image") else None, request.overwrite)
    lens, lens_size = read_lens(options["camera"]) if options.get("camera") else (None, None)
    image = _read_image(options["image"]) if options.get("image") else None
    size = _agreed_size(image, options, lens_size)
    warnings: list[str] = []
    if options.get("gaze"):
        marks, world, fit = _from_gaze(options["gaze"], config)
    elif options.get("lines"):
        marks, world, fit = _from_lines(options["lines"], config, image, lens, warnings)
    else:
        marks, world, fit = _from_points(options["points"], config, lens)
    warnings += _doubts(fit, marks, size if not options.get("gaze") else None, config)
    ground = GroundMap(
        ground_from_image=fit.H,
        cov=fit.cov,
        ground_sign=fit.ground_sign,
        input="gaze" if options.get("gaze") else "pixel",
        image_size=size,
        lens=lens,
        rms_m=fit.rms_m,
        rms_px=fit.rms_px,
        residuals=_residuals(fit),
        source=request.input.name,
    )
    homography_files.write(request.out, ground)
    if image is not None and not options.get("gaze"):
        drawn = draw(image, ground, marks, world, fit.used, config.noise.sigma_px)
        with replacing(picture_path) as file:
            file.write(cv2.imencode(".png", drawn)[1].tobytes())
    return RunResult(request.out, _summary(request, ground, fit, marks, warnings), tuple(warnings))


def _check_output(out: Path, picture: Path | None, overwrite: bool) -> None:
    if out.is_dir():
        raise OutputError(f"{out}: is a folder; give --out the name of a file, like H.json")
    if not out.parent.is_dir():
        raise OutputError(f"{out.parent}: no such folder")
    for path in (out, picture):
        if path is not None and path.exists() and not overwrite:
            raise OutputError(f"{path}: exists; give --overwrite or another name")


def _read_image(path: Path) -> Image:
    """A picture, or the first frame of a clip, as 8-bit BGR."""
    if path.is_file():
        try:
            data = np.fromfile(path, np.uint8)
        except OSError as problem:
            raise InputError(f"{path}: cannot be read: {problem.strerror or problem}") from problem
        image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
        if image is not None:
            return np.asarray(image, dtype=np.uint8)
    with open_source(path, fps=1.0) as source:
        return next(source.frames()).image


def _agreed_size(image: Image | None, options: dict[str, Any], lens_size: Size | None) -> Size | None:
    known: list[tuple[str, Size]] = []
    if image is not None:
        known.append((f"--image {options['image']}", (image.shape[1], image.shape[0])))
    if options.get("size"):
        known.append(("--size", options["size"]))
    if lens_size is not None:
        known.append((f"--camera {options['camera']}", lens_size))
    for name, size in known[1:]:
        if size != known[0][1]:
            first, (w, h) = known[0]
            raise InputError(f"{first} is {w}x{h}, but {name} says {size[0]}x{size[1]}; they must agree")
    return known[0][1] if known else None


def _from_points(path: Path, config: CalibrateConfig, lens: Lens | None) -> tuple[Array, Array, Fit]:
    marks, world = read_points(path)
    image = marks if lens is None else undistort_points(marks, lens)
    return marks, world, _named(path, lambda: fit_points(image, world, *_fitting(config)))


def _from_lines(
    path: Path, config: CalibrateConfig, image: Image | None, lens: Lens | None, warnings: list[str]
) -> tuple[Array, Array, Fit]:
    marks, world = read_lines(path)
    if config.snap.enabled:
        if image is None:
            raise UsageError("snap.enabled needs --image: lines are moved onto the edges of a picture")
        marks, snapped = snap(image, marks, config.snap.radius_px)
        warnings += [f"line {k + 1} has no edge under it and stays as drawn" for k in np.flatnonzero(~snapped)]
    straight = marks if lens is None else undistort_points(marks.reshape(-1, 2), lens).reshape(-1, 4)
    return marks, world, _named(path, lambda: fit_lines(straight, world, *_fitting(config)))


def _from_gaze(path: Path, config: CalibrateConfig) -> tuple[Array, Array, Fit]:
    angles, world = read_gaze(path)
    marks = gaze.frontal(angles[:, 0], angles[:, 1], config.gaze.order)
    robust = config.robust.threshold_rad if config.robust.enabled else None
    return (
        marks,
        world,
        _named(path, lambda: fit_points(marks, world, config.noise.sigma_rad, robust, config.limits.condition)),
    )


def _fitting(config: CalibrateConfig) -> tuple[float, float | None, float]:
    robust = config.robust.threshold_px if config.robust.enabled else None
    return config.noise.sigma_px, robust, config.limits.condition


def _named(path: Path, fit: Any) -> Fit:
    """Run a fit; its refusal names the file."""
    try:
        result: Fit = fit()
    except InputError as problem:
        raise InputError(f"{path}: {problem}") from problem
    except np.linalg.LinAlgError as problem:
        raise InputError(f"{path}: these points do not determine a homography ({problem})") from problem
    return result


def _doubts(fit: Fit, marks: Array, size: Size | None, config: CalibrateConfig) -> list[str]:
    """What a person should know before trusting this calibration."""
    doubts = []
    for k in np.flatnonzero(~fit.used):
        doubts.append(f"row {k + 1} disagrees with the others by {fit.error_px[k]:.1f} px and was dropped")
    if fit.used.sum() < FEW:
        doubts.append(f"{int(fit.used.sum())} points leave little to check them with; six or more are better")
    for k in np.flatnonzero(np.nan_to_num(fit.leave_one_out_m) > config.limits.leave_one_out_m):
        doubts.append(
            f"leaving out row {k + 1} moves it by {fit.leave_one_out_m[k]:.1f} m: the calibration hangs on it"
        )
    if size is not None:
        for k, mark in enumerate(marks):
            ends = mark.reshape(-1, 2)
            if np.any((ends < -0.5) | (ends > np.array(size) - 0.5)):
                doubts.append(f"row {k + 1} lies outside the {size[0]}x{size[1]} image")
    return doubts


def _residuals(fit: Fit) -> tuple[dict[str, Any], ...]:
    return tuple(
        {
            "index": k,
            "error_m": float(fit.error_m[k]),
            "error_px": float(fit.error_px[k]),
            "leave_one_out_m": float(fit.leave_one_out_m[k]) if np.isfinite(fit.leave_one_out_m[k]) else None,
            "used": bool(fit.used[k]),
        }
        for k in range(len(fit.used))
    )


def _summary(request: RunRequest, ground: GroundMap, fit: Fit, marks: Array, warnings: list[str]) -> dict[str, Any]:
    left_out = fit.leave_one_out_m[np.isfinite(fit.leave_one_out_m)]
    summary: dict[str, Any] = {
        "out": str(request.out),
        "input": ground.input,
        "n": len(fit.used),
        "used": int(fit.used.sum()),
        "rms_m": fit.rms_m,
        "rms_px": fit.rms_px,
        "leave_one_out_worst_m": float(left_out.max()) if len(left_out) else None,
        "condition": fit.condition,
        "warnings": warnings,
    }
    if ground.input == "pixel":
        centre = marks.reshape(-1, 2).mean(axis=0, keepdims=True)
        error = float(speed_error(ground, centre, fit.sigma_px)[0])
        summary["speed_sigma_kmh"] = error if np.isfinite(error) else None
    return summary


def text(result: RunResult) -> str:
    """The summary for people."""
    s = result.summary
    unit, scale = ("px", 1.0) if s["input"] == "pixel" else ("mrad", 1000.0)
    lines = [
        f"used         {s['used']} of {s['n']}",
        f"residual     {s['rms_m']:.3f} m, {s['rms_px'] * scale:.2f} {unit} (rms)",
    ]
    if s["leave_one_out_worst_m"] is not None:
        lines.append(f"leave one out {s['leave_one_out_worst_m']:.2f} m at worst")
    if s.get("speed_sigma_kmh") is not None:
        lines.append(f"expect       +-{1.96 * s['speed_sigma_kmh']:.1f} km/h (95 %) on 50 km/h over 1 s, mid-survey")
    lines.append(f"homography   {s['out']}")
    return "\n".join(lines)
