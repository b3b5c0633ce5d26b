"""Both views side by side, with quads, paths, and particles' places where there are any."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from visfuse_cli.facing.output import shown
from visfuse_cli.maths.planes import in_right, projected
from visfuse_cli.records import Array, Image, StereoRig
from visfuse_cli.vision import drawing

UNITS = {"km/h": 3.6, "mph": 2.2369362920544, "m/s": 1.0}
WIDEST = 1920  # px of both views together
TRAIL = 60  # states
PATH, PARTICLE = (200, 200, 200), (60, 220, 255)
FAR_OFF = 1e4  # px


class Drawn:
    """One settled track of tracks.json, ready to be drawn."""

    def __init__(
        self, record: dict[str, Any], rig: StereoRig, units: str, clouds: dict[int, Array], way: Array
    ) -> None:
        self.id = int(record["id"])
        self._rig, self._units = rig, units
        self._clouds, self._way = clouds, way
        self._states = {int(state["frame"]): state for state in record["states"]}
        self._places = np.array([state["position"] for state in record["states"]])
        self._frames = np.array([state["frame"] for state in record["states"]])
        self._speed = float(record["summary"]["speed"])
        self.colour = drawing.colour_of(self.id)

    def draw(self, pictures: dict[str, Image], frame: int) -> None:
        """Draw one frame onto both views."""
        state = self._states.get(frame)
        if state is None:
            return
        upto = int(np.searchsorted(self._frames, frame, side="right"))
        for view, image in pictures.items():
            drawing.polyline(image, self._seen(view, self._way), PATH, width=1)
            for dot in self._seen(view, self._clouds.get(frame, np.zeros((0, 3)))):
                cv2.circle(image, (round(dot[0]), round(dot[1])), 1, PARTICLE, -1, cv2.LINE_AA)
            drawing.polyline(image, self._seen(view, self._places[:upto][-TRAIL:]), self.colour)
            quad = state["quad"].get(view)
            if quad is not None:
                drawing.polyline(image, np.array(quad), self.colour, closed=True)
                speed, mean = (value * UNITS[self._units] for value in (state["speed"], self._speed))
                text = f"{self.id}  {speed:.1f} {self._units} (mean {mean:.1f})"
                drawing.label(image, text, np.array(quad).min(axis=0) - [0, 4], self.colour)

    def _seen(self, view: str, places: Array) -> Array:
        """Pixels (n, 2) of those places (n, 3) m that lie before the camera."""
        lens = self._rig.left if view == "left" else self._rig.right
        pixels = projected(lens.K, places if view == "left" else in_right(self._rig, places))
        return shown(pixels[np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < FAR_OFF).all(axis=1)], lens)


def together_size(width: int, height: int) -> tuple[int, int]:
    """Even width and height (px) of both views side by side."""
    scale = min(1.0, WIDEST / (2 * width))
    return int(width * scale) // 2 * 4, int(height * scale) // 2 * 2


def together(left: Image, right: Image, t: float) -> Image:
    """Both views side by side."""
    wide, high = together_size(left.shape[1], left.shape[0])
    half = (wide // 2, high)
    parts = [view if (view.shape[1], view.shape[0]) == half else _small(view, half) for view in (left, right)]
    picture = np.hstack(parts)
    drawing.label(picture, f"left  {t:.2f} s", np.array([4.0, high]), (230, 230, 230))
    drawing.label(picture, "right", np.array([4.0 + wide / 2, high]), (230, 230, 230))
    return np.asarray(picture, np.uint8)


def _small(view: Image, size: tuple[int, int]) -> Image:
    return np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_AREA), np.uint8)
