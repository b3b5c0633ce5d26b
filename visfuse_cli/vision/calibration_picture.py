"""The picture beside H.json: the ground grid, the residuals and where the calibration can be trusted."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.maths.calibration_error import speed_error
from visfuse_cli.maths.homography import apply, depth
from visfuse_cli.records import Array, GroundMap, Image
from visfuse_cli.vision import drawing
from visfuse_cli.vision.lens import distort_points, undistort_points

LEVELS = (1.0, 2.0, 5.0, 10.0, 20.0)  # km/h
COLOURS = ((80, 170, 60), (60, 190, 150), (40, 200, 230), (30, 140, 245), (50, 60, 230), (60, 30, 120))  # BGR
EXAGGERATION = 10  # residuals are drawn this much longer


def draw(image: Image, ground: GroundMap, marks: Array, world: Array, used: Array, sigma_px: float) -> Image:
    """Draw on a frame (H, W, 3): grid in metres, points or lines (marks (N, 2 or 4) px, world (N, 2 or 4) m) with
    residuals, dropped ones crossed, and the expected error of 50 km/h over one second as colours."""
    out = _error_colours(image, ground, sigma_px)
    _grid(out, ground, world.reshape(-1, 2))
    width = drawing.stroke(out)
    for index, mark in enumerate(marks):
        colour = (255, 255, 255) if used[index] else (60, 60, 255)
        ends = mark.reshape(-1, 2)
        mapped = _to_image(ground, world[index].reshape(-1, 2))
        if len(ends) == 1:
            drawing.polyline(
                out, np.stack([ends[0], ends[0] + EXAGGERATION * (mapped[0] - ends[0])]), colour, width=width
            )
            cv2.circle(out, tuple(np.round(ends[0]).astype(int).tolist()), 3 * width, colour, width, cv2.LINE_AA)
        else:
            drawing.polyline(out, ends, colour, width=2 * width)
        label = f"{index + 1}" if used[index] else f"{index + 1} dropped"
        drawing.label(out, label, ends[0] + 4.0 * width, colour, 0.8)
    _legend(out)
    return out


def _to_image(ground: GroundMap, world: Array) -> Array:
    """Ground points (N, 2) m to the footage's pixels; NaN beyond the horizon."""
    pixels = apply(np.linalg.inv(ground.ground_from_image), world)
    pixels[depth(ground.ground_from_image, pixels) * ground.ground_sign <= 0] = np.nan
    if ground.lens is not None:
        pixels = distort_points(pixels, ground.lens)
    return pixels


def _error_colours(image: Image, ground: GroundMap, sigma_px: float) -> Image:
    height, width = image.shape[:2]
    step = max(1, height // 180)
    v, u = np.mgrid[0:height:step, 0:width:step]
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    if ground.lens is not None:
        pixels = undistort_points(pixels, ground.lens)
    error = speed_error(ground, pixels, sigma_px).reshape(u.shape)
    level = np.searchsorted(LEVELS, np.nan_to_num(error, nan=np.inf))
    colours = np.array(COLOURS, dtype=np.uint8)[level]
    colours = cv2.resize(colours, (width, height), interpolation=cv2.INTER_NEAREST)
    known = cv2.resize(np.isfinite(error).astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    out = np.asarray(cv2.addWeighted(image, 0.68, colours, 0.32, 0), dtype=np.uint8)
    out[known == 0] = (image[known == 0] * 0.5).astype(np.uint8)
    return out


def _grid(out: Image, ground: GroundMap, world: Array) -> None:
    """Lines of equal X and Y over the surveyed area and half as much around it."""
    low, high = world.min(axis=0), world.max(axis=0)
    margin = 0.5 * (high - low).max()
    raw = ((high - low).max() + 2 * margin) / 12
    spacing = next(m * 10.0**e for e in range(-3, 6) for m in (1, 2, 5) if m * 10.0**e >= raw)
    low, high = np.floor((low - margin) / spacing), np.ceil((high + margin) / spacing)
    for axis in (0, 1):
        for number in np.arange(low[axis], high[axis] + 1):
            other = np.linspace(low[1 - axis], high[1 - axis], 200) * spacing
            line = np.empty((len(other), 2))
            line[:, axis], line[:, 1 - axis] = number * spacing, other
            pixels = _to_image(ground, line)
            near = np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < 20 * max(out.shape)).all(axis=1)
            for piece in np.split(pixels, np.flatnonzero(np.diff(near)) + 1):
                if np.isfinite(piece).all() and np.abs(piece).max() < 20 * max(out.shape):
                    drawing.polyline(out, piece, (235, 235, 235))
            shown = pixels[near & (pixels >= 0).all(axis=1) & (pixels < out.shape[1::-1]).all(axis=1)]
            if len(shown):
                drawing.label(
                    out, f"{'XY'[axis]} {number * spacing:g} m", shown[len(shown) // 2], (235, 235, 235), 0.65
                )


def _legend(out: Image) -> None:
    bounds = (0.0, *LEVELS)
    text = (
        [f"< {LEVELS[0]:g}"]
        + [f"{a:g}-{b:g}" for a, b in zip(bounds[1:], bounds[2:], strict=False)]
        + [f"> {LEVELS[-1]:g}"]
    )
    line = max(14, out.shape[0] // 28)
    drawing.label(out, "sigma of 50 km/h over 1 s, km/h", np.array([line * 0.4, line * 1.1]), (255, 255, 255), 0.8)
    for k, (name, colour) in enumerate(zip(text, COLOURS, strict=True)):
        drawing.label(out, name, np.array([line * 0.4, line * (2.3 + k)]), colour, 0.8)
    note = f"residuals x{EXAGGERATION}"
    drawing.label(out, note, np.array([line * 0.4, line * (2.3 + len(text))]), (255, 255, 255), 0.8)
