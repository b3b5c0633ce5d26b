"""The picture beside H.json: the ground grid, the residuals and where the calibration can be trusted."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.calibration_error import speed_error
from visfuse_cli.maths.homography import apply, depth, invert
from visfuse_cli.records import Array, GroundMap, Image
from visfuse_cli.vision import drawing
from visfuse_cli.vision.lens import distort_points, undistort_points

LEVELS = (1.0, 2.0, 5.0, 10.0, 20.0)  # km/h
COLOURS = ((70, 190, 40), (40, 220, 180), (0, 225, 255), (0, 140, 255), (40, 40, 240), (130, 0, 110))  # BGR
TINT = 0.36  # share of the colour over the picture
WHITE, RED, PALE = (255, 255, 255), (90, 90, 255), (235, 235, 235)
EXAGGERATION = 10  # residuals are drawn this much longer
FAR = 20  # picture widths: ground lines further out are not drawn


def draw(
    image: Image, ground: GroundMap, marks: Array, world: Array, used: NDArray[np.bool_], sigma_px: float
) -> Image:
    """Draw on a copy of a frame (H, W, 3) what H.json promises there.

    The grid in metres; points or lines (marks (N, 2 or 4) px, world (N, 2 or 4) m) with their residuals, dropped ones
    in red; and as colours the standard deviation of 50 km/h measured over one second with `sigma_px` of noise.
    """
    out = _error_colours(image, ground, sigma_px)
    _grid(out, ground, world.reshape(-1, 2))
    for index, mark in enumerate(marks):
        mapped = to_image(ground, world[index].reshape(-1, 2))
        _mark(out, index, mark.reshape(-1, 2), mapped, bool(used[index]))
    _legend(out, sigma_px)
    return out


def to_image(ground: GroundMap, world: Array) -> Array:
    """Ground points (N, 2) m to the footage's pixels; NaN beyond the horizon."""
    with np.errstate(all="ignore"):
        pixels = apply(invert(ground.ground_from_image), world)
    pixels[~(depth(ground.ground_from_image, pixels) * ground.ground_sign > 0)] = np.nan
    if ground.lens is not None:
        # far outside of the picture the lens polynomial folds back into it
        pixels[np.abs(pixels).max(axis=1) > 4 * np.abs(ground.lens.K).max()] = np.nan
        seen = np.isfinite(pixels).all(axis=1)
        if seen.any():
            pixels[seen] = distort_points(pixels[seen], ground.lens)
    return pixels


def error_field(ground: GroundMap, size: tuple[int, int], step: int, sigma_px: float) -> Array:
    """Standard deviation (h, w) km/h of 50 km/h over one second at every step-th pixel of a picture of size (w, h).

    The last row and column lie on the picture's border; NaN above the horizon.
    """
    width, height = size
    v, u = np.mgrid[0 : height + step : step, 0 : width + step : step]
    pixels = np.column_stack([np.minimum(u.ravel(), width - 1), np.minimum(v.ravel(), height - 1)]).astype(float)
    if ground.lens is not None:
        pixels = undistort_points(pixels, ground.lens)
    return speed_error(ground, pixels, sigma_px).reshape(u.shape)


def _error_colours(image: Image, ground: GroundMap, sigma_px: float) -> Image:
    """The frame tinted by the expected error, with the levels' borders; dark above the horizon."""
    height, width = image.shape[:2]
    step = max(1, height // 180)
    field = error_field(ground, (width, height), step, sigma_px)
    known = _enlarged(np.isfinite(field).astype(np.float32), step, image) > 0.5
    error = _enlarged(np.nan_to_num(np.log(field), nan=9.0).astype(np.float32), step, image)
    level = np.searchsorted(np.log(LEVELS), error).astype(np.uint8)
    colours = np.array(COLOURS, dtype=np.uint8)[level]
    out = (image * (1 - TINT) + colours * TINT).astype(np.uint8)
    border = cv2.morphologyEx(level, cv2.MORPH_GRADIENT, np.ones((1 + drawing.stroke(image),) * 2, np.uint8)) > 0
    out[border] = colours[border]
    out[~known] = (image[~known] * 0.45).astype(np.uint8)
    return out


def _enlarged(coarse: NDArray[np.float32], step: int, image: Image) -> NDArray[np.float32]:
    """Values at every step-th pixel, interpolated to all pixels of the picture."""
    height, width = image.shape[:2]
    shrink = np.array([[1 / step, 0, 0], [0, 1 / step, 0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(coarse, shrink, (width, height), flags=flags), dtype=np.float32)


def grid_lines(ground: GroundMap, world: Array, size: tuple[int, int]) -> Iterator[tuple[int, float, list[Array]]]:
    """Lines of equal X (axis 0) and Y (axis 1) over the surveyed area and half as much around it, with their metres.

    Each comes as the pieces (k, 2) px of it that may be seen in a picture of size (w, h).
    """
    low, high = world.min(axis=0), world.max(axis=0)
    margin = 0.5 * (high - low).max()
    raw = ((high - low).max() + 2 * margin) / 12
    spacing = next(m * 10.0**e for e in range(-6, 12) for m in (1, 2, 5) if m * 10.0**e >= raw)
    low, high = np.floor((low - margin) / spacing), np.ceil((high + margin) / spacing)
    for axis in (0, 1):
        for number in np.arange(low[axis], high[axis] + 1):
            other = np.linspace(low[1 - axis], high[1 - axis], 200) * spacing
            line = np.empty((len(other), 2))
            line[:, axis], line[:, 1 - axis] = number * spacing, other
            yield axis, number * spacing + 0.0, _near(to_image(ground, line), size)


def _near(pixels: Array, size: tuple[int, int]) -> list[Array]:
    """The pieces of a line (k, 2) px that lie in the picture or not far from it."""
    with np.errstate(invalid="ignore"):
        near: NDArray[np.bool_] = np.asarray((np.abs(pixels) < FAR * np.array(size)).all(axis=1))
    cuts = [0, *(np.flatnonzero(np.diff(near)) + 1), len(near)]
    return [pixels[start:end] for start, end in pairwise(cuts) if near[start]]


def _grid(out: Image, ground: GroundMap, world: Array) -> None:
    """The grid with its metres, where they have room."""
    size = out.shape[1::-1]
    labels: list[tuple[str, Array]] = []
    for axis, metres, pieces in grid_lines(ground, world, (size[0], size[1])):
        inside = [piece[((piece >= 0) & (piece < size)).all(axis=1)] for piece in pieces]
        for piece in pieces:
            drawing.polyline(out, piece, PALE)
        if shown := [place for piece in inside for place in piece]:
            # X near the end of its lines and Y near the middle, where they seldom meet
            labels.append((f"{'XY'[axis]} {metres:g} m", shown[len(shown) // (2 if axis else 8)]))
    taken: list[Array] = []
    room = np.array([0.11, 0.04]) * out.shape[0]
    legend = np.array([0.3, 0.36]) * out.shape[0]
    for text, place in labels:
        if np.any(place > legend) and all(np.any(np.abs(place - other) > room) for other in taken):
            taken.append(place)
            drawing.label(out, text, place, PALE, 0.65)


def _mark(out: Image, index: int, ends: Array, mapped: Array, used: bool) -> None:
    """A point with its residual, or a line with the mapped world line's ends, and its number in the table."""
    width, colour = drawing.stroke(out), WHITE if used else RED
    if len(ends) == 1:
        drawing.polyline(out, np.stack([ends[0], ends[0] + EXAGGERATION * (mapped[0] - ends[0])]), colour, width=width)
        _circle(out, ends[0], 4 * width, colour)
    else:
        drawing.polyline(out, ends, colour, width=2 * width)
        _line_residuals(out, ends, mapped, colour)
    drawing.label(out, f"{index + 1}" if used else f"{index + 1} dropped", ends[0] + 8.0 * width, colour, 0.75)


def _line_residuals(out: Image, ends: Array, mapped: Array, colour: drawing.Colour) -> None:
    """How far the two points of a drawn line (2, 2) px lie from the mapped world line, through mapped (2, 2) px."""
    if not np.isfinite(mapped).all():
        return
    along = (mapped[1] - mapped[0]) / max(float(np.hypot(*(mapped[1] - mapped[0]))), 1e-9)
    across = np.array([-along[1], along[0]])
    for end in ends:
        drawing.polyline(out, np.stack([end, end + EXAGGERATION * ((mapped[0] - end) @ across) * across]), colour)
        _circle(out, end, 3 * drawing.stroke(out), colour)


def _circle(out: Image, at: Array, radius: int, colour: drawing.Colour) -> None:
    if np.abs(at).max() < 2 * max(out.shape):
        centre = tuple(np.round(at).astype(int).tolist())
        cv2.circle(out, centre, radius, (0, 0, 0), drawing.stroke(out) + 2, cv2.LINE_AA)
        cv2.circle(out, centre, radius, colour, drawing.stroke(out), cv2.LINE_AA)


def _legend(out: Image, sigma_px: float) -> None:
    """The colours and what they mean, in the upper left corner."""
    names = [f"< {LEVELS[0]:g}", *(f"{a:g} - {b:g}" for a, b in pairwise(LEVELS)), f"> {LEVELS[-1]:g}"]
    line = max(16, out.shape[0] // 28)
    lines = ["50 km/h over 1 s: sigma, km/h", *names, f"picking noise {sigma_px:g} px", f"residuals x{EXAGGERATION}"]
    for k, text in enumerate(lines):
        foot = np.array([line * 0.4, line * (1.1 + k)])
        if 0 < k <= len(names):
            corner, far = (foot - [0, 0.65 * line]).astype(int), (foot + [1.4 * line, 0.15 * line]).astype(int)
            cv2.rectangle(out, tuple(corner.tolist()), tuple(far.tolist()), COLOURS[k - 1], -1)
            foot = foot + [1.8 * line, 0]
        drawing.label(out, text, foot, WHITE, 0.75)
