"""`visfuse calibrate-homography`: surveyed points, lines or gaze angles to H.json and a picture that shows its worth.

table -> (undistort, snap) -> fit -> ground map -> H.json, picture, summary
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from pydantic import Field

from visfuse_cli.config import Section
from visfuse_cli.errors import InputError, OutputError, UsageError
from visfuse_cli.files import homography as homography_files
from visfuse_cli.files.atomic import failing_as_output, replacing
from visfuse_cli.files.calibration_input import read_gaze, read_lines, read_points
from visfuse_cli.files.lens_files import read_lens
from visfuse_cli.files.stills import Stills
from visfuse_cli.maths import gaze
from visfuse_cli.maths.calibration_error import speed_error
from visfuse_cli.maths.homography_fit import Fit, fit_points
from visfuse_cli.maths.lines import fit_lines
from visfuse_cli.records import Array, GroundMap, Image, Lens, RunRequest, RunResult
from visfuse_cli.vision.calibration_picture import draw
from visfuse_cli.vision.lens import distort_points, undistort_points
from visfuse_cli.vision.line_tracing import snap

Size = tuple[int, int]
FEW = 6  # below, leaving one out says more about the others' places than about its own
FAR = 3e4  # the survey's distance from the world's origin, in its own extents, before double precision runs out


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


@dataclass(frozen=True, slots=True)
class Survey:
    """What was surveyed (marks (N, 2 or 4) in the image, world (N, 2 or 4) m) and the homography through it."""

    noun: str
    marks: Array
    world: Array
    fit: Fit
    warnings: tuple[str, ...] = ()
    input: str = "pixel"


def run(request: RunRequest) -> RunResult:
    """Fit the homography and write it with its picture; raises InputError for input that cannot carry one."""
    config: CalibrateConfig = request.config
    options = request.options
    drawable = options.get("image") and not options.get("gaze")
    check_output(request, (request.out.with_suffix(".png"),) if drawable else ())
    lens, lens_size = read_lens(options["camera"]) if options.get("camera") else (None, None)
    image = Stills(options["image"]).at(0.0)[1] if options.get("image") else None
    size = _agreed_size(image, options, lens_size)
    survey = _survey(options, config, image, lens)
    ground = ground_map(request, survey, size, lens, request.input.name)
    return write(request, survey, ground, image if drawable else None)


def ground_map(request: RunRequest, survey: Survey, size: Size | None, lens: Lens | None, source: str) -> GroundMap:
    """What a survey says about the ground before a camera of that size and lens."""
    return GroundMap(
        ground_from_image=survey.fit.H,
        cov=survey.fit.cov,
        ground_sign=survey.fit.ground_sign,
        input=survey.input,
        image_size=size,
        lens=lens,
        rms_m=survey.fit.rms_m,
        rms_px=survey.fit.rms_px,
        residuals=_residuals(survey.fit),
        source=source,
        reference=request.options.get("reference"),
    )


def write(request: RunRequest, survey: Survey, ground: GroundMap, image: Image | None) -> RunResult:
    """Write H.json, and over `image` the picture beside it; the summary tells what to think of them."""
    config, picture = request.config, None
    if image is not None:
        drawn = draw(image, ground, survey.marks, survey.world, survey.fit.used, config.noise.sigma_px)
        picture = request.out.with_suffix(".png")
        encoded = cv2.imencode(".png", drawn)[1].tobytes()
    if picture is not None:
        with replacing(picture) as file:
            file.write(encoded)
    homography_files.write(request.out, ground)
    warnings = (*survey.warnings, *doubts(survey, ground.image_size, config))
    return RunResult(request.out, _summary(request, ground, survey, picture, warnings), warnings)


def check_output(request: RunRequest, beside: tuple[Path, ...]) -> None:
    """Raise OutputError where H.json, or a file beside it, cannot be written or would replace something."""
    out = request.out
    with failing_as_output(out):
        if out.is_dir():
            raise OutputError(f"{out}: is a folder; give --out the name of a file, like H.json")
        if not out.parent.is_dir():
            raise OutputError(f"{out.parent}: no such folder")
        out.exists()
    if out in beside:
        raise OutputError(f"{out}: a file beside it would take its name; give --out a name that ends in .json")
    inputs = [path for path in request.options.values() if isinstance(path, Path)]
    for path in (out, *beside):
        if not path.exists():
            continue
        if any(given.exists() and path.samefile(given) for given in inputs):
            raise OutputError(f"{path}: is an input and would be overwritten; give --out another name")
        if not request.overwrite:
            raise OutputError(f"{path}: exists; give --overwrite or another name")


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


def _survey(options: dict[str, Any], config: CalibrateConfig, image: Image | None, lens: Lens | None) -> Survey:
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


def _residuals(fit: Fit) -> tuple[dict[str, Any], ...]:
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


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _summary(
    request: RunRequest, ground: GroundMap, survey: Survey, picture: Path | None, warnings: tuple[str, ...]
) -> dict[str, Any]:
    fit = survey.fit
    left_out = fit.leave_one_out_m[np.isfinite(fit.leave_one_out_m)]
    summary: dict[str, Any] = {
        "out": str(request.out),
        "picture": None if picture is None else str(picture),
        "input": ground.input,
        "n": len(fit.used),
        "used": int(fit.used.sum()),
        "dropped": [int(k) + 1 for k in np.flatnonzero(~fit.used)],
        "rms_m": fit.rms_m,
        "rms_px": fit.rms_px,
        "sigma_px": fit.sigma_px,
        "leave_one_out_worst_m": float(left_out.max()) if len(left_out) else None,
        "condition": fit.condition,
        "warnings": list(warnings),
    }
    if ground.input == "pixel":
        summary["speed_sigma_kmh"] = speed_sigma(survey, ground, request.config)
    return summary


def speed_sigma(survey: Survey, ground: GroundMap, config: CalibrateConfig) -> float | None:
    """Standard deviation (km/h) to expect of 50 km/h over one second in the middle of the survey."""
    marks = survey.marks[survey.fit.used].reshape(-1, 2).mean(axis=0, keepdims=True)
    centre = marks if ground.lens is None else undistort_points(marks, ground.lens)
    return _finite(speed_error(ground, centre, config.noise.sigma_px)[0])


def text(result: RunResult) -> str:
    """The summary for people."""
    s = result.summary
    unit, scale = ("px", 1.0) if s["input"] == "pixel" else ("mrad", 1000.0)
    dropped = f", dropped {', '.join(map(str, s['dropped']))}" if s["dropped"] else ""
    lines = [
        f"used         {s['used']} of {s['n']}{dropped}",
        f"residual     {s['rms_m']:.3f} m, {s['rms_px'] * scale:.2f} {unit} (rms)",
        f"condition    {s['condition']:.3g}",
    ]
    if s["leave_one_out_worst_m"] is not None:
        lines.append(f"leave one out {s['leave_one_out_worst_m']:.2f} m at worst")
    if s.get("speed_sigma_kmh") is not None:
        lines.append(f"expect       +-{1.96 * s['speed_sigma_kmh']:.1f} km/h (95 %) on 50 km/h over 1 s, mid-survey")
    lines.append(f"homography   {s['out']}")
    if s["picture"] is not None:
        lines.append(f"picture      {s['picture']}")
    return "\n".join(lines)
