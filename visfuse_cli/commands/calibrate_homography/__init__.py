"""`visfuse calibrate-homography`: surveyed points, lines or gaze angles to H.json and a picture that shows its worth.

table -> (undistort, snap) -> fit -> ground map -> H.json, picture, summary
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from visfuse_cli.commands.calibrate_homography.settings import CalibrateConfig
from visfuse_cli.commands.calibrate_homography.survey import (
    Size,
    Survey,
    doubts,
    from_lines,
    from_points,
    read,
    residuals,
    speed_sigma,
)
from visfuse_cli.errors import InputError, OutputError
from visfuse_cli.files import homography as homography_files
from visfuse_cli.files.atomic import failing_as_output, replacing
from visfuse_cli.files.lens_files import read_lens
from visfuse_cli.files.stills import Stills
from visfuse_cli.records import GroundMap, Image, Lens, RunRequest, RunResult
from visfuse_cli.vision.calibration_picture import draw

__all__ = ["CalibrateConfig", "Survey", "doubts", "from_lines", "from_points", "run", "speed_sigma", "text"]


def run(request: RunRequest) -> RunResult:
    """Fit the homography and write it with its picture; raises InputError for input that cannot carry one."""
    config: CalibrateConfig = request.config
    options = request.options
    drawable = options.get("image") and not options.get("gaze")
    check_output(request, (request.out.with_suffix(".png"),) if drawable else ())
    lens, lens_size = read_lens(options["camera"]) if options.get("camera") else (None, None)
    image = Stills(options["image"]).at(0.0)[1] if options.get("image") else None
    size = _agreed_size(image, options, lens_size)
    survey = read(options, config, image, lens)
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
        residuals=residuals(survey.fit),
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
