"""What the annotated video shows, at sizes that follow the picture: legible from 360 lines to 4K."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np

from visfuse_cli.records import Array, Image
from visfuse_cli.vision.wireframe import EDGES

SHIFT = 4  # sub-pixel bits of OpenCV's drawing coordinates
DIMMED = (np.arange(256) * 0.35).astype(np.uint8)  # what lies behind writing
Colour = tuple[int, int, int]


def colour_of(track_id: int) -> Colour:
    """A bright BGR colour that stays with a track and differs from its neighbours'."""
    red, green, blue = colorsys.hsv_to_rgb((track_id * 0.61803398875) % 1.0, 0.75, 1.0)
    return int(255 * blue), int(255 * green), int(255 * red)


def stroke(image: Image) -> int:
    """Line width in px for this picture."""
    return max(1, round(image.shape[0] / 540))


def _fixed(points: Array) -> np.ndarray:
    return np.round(np.clip(points, -16000, 16000) * (1 << SHIFT)).astype(np.int32)


def polyline(image: Image, points: Array, colour: Colour, closed: bool = False, width: int | None = None) -> None:
    """Draw a line through points (k, 2) px onto the image; points that are not finite interrupt it."""
    if len(points) > 1 and np.isfinite(points).all():
        cv2.polylines(image, [_fixed(points)], closed, colour, width or stroke(image), cv2.LINE_AA, SHIFT)


def box(image: Image, corners: Array, colour: Colour, dashed: bool = False) -> None:
    """Draw a wireframe through its eight corners (8, 2) px; dashed where it is a prediction."""
    if not np.isfinite(corners).all():
        return
    a, b = corners[EDGES[:, 0], None], corners[EDGES[:, 1], None]  # (12, 1, 2)
    cuts = a + (b - a) * (np.linspace(0, 1, 8) if dashed else np.arange(2.0))[:, None]
    lines = _fixed(cuts.reshape(-1, 2, 2))
    cv2.polylines(image, list(lines), False, colour, stroke(image), cv2.LINE_AA, SHIFT)


def label(image: Image, text: str, at: Array, colour: Colour, scale: float = 1.0) -> None:
    """Write text with its lower left corner near `at` (2,) px on a dark plate, kept inside the picture."""
    height, width = image.shape[:2]
    size = scale * max(0.38, height / 1300)
    thick = max(1, round(size * 1.6))
    (w, h), baseline = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, thick)
    pad = max(2, h // 4)
    x = int(np.clip(at[0], pad, max(pad, width - w - pad)))
    y = int(np.clip(at[1], h + pad, max(h + pad, height - baseline - pad)))
    left, top, right, bottom = max(0, x - pad), max(0, y - h - pad), x + w + pad, y + baseline + pad // 2
    image[top:bottom, left:right] = cv2.LUT(image[top:bottom, left:right], DIMMED)
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, colour, thick, cv2.LINE_AA)
