"""The view with the targets' boxes and where they will be, and a small map of the ground with the head and its gaze."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from visfuse_cli.gazing.head import Head
from visfuse_cli.moving.annotate import OUT_OF_SIGHT, SHARE, UNITS, WHITE
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, Image
from visfuse_cli.vision import drawing

TRAIL_S = 2.0
UNTOLD = {"position": [np.nan] * 2}


class Drawn:
    """What is drawn of one settled track of tracks.json."""

    def __init__(self, record: dict[str, Any], head: Head, config: ImmConfig) -> None:
        self.id, self._head = int(record["id"]), head
        self._height, self._units = config.target.height or 0.0, config.display.units
        self.frames, self.places, self._t, self._speeds, self._measured = (
            np.array([state[name] for state in record["states"]])
            for name in ("frame", "position", "t", "speed", "measured")
        )
        self._boxes = np.array([state["box"].get("left", OUT_OF_SIGHT) for state in record["states"]])
        self._ahead = np.array([state.get("ahead", UNTOLD)["position"] for state in record["states"]])
        self.colour = drawing.colour_of(self.id)

    def draw(self, picture: Image, frame: int, gaze: Array) -> None:
        """Draw one frame: the box, the way so far, the estimate in white, and where it will be a latency later."""
        k = int(np.searchsorted(self.frames, frame))
        if k == len(self.frames) or self.frames[k] != frame:
            return
        begin = int(np.searchsorted(self._t, self._t[k] - TRAIL_S))
        drawing.polyline(picture, self._seen(self.places[begin : k + 1], 0.0, gaze), self.colour)
        x, y, w, h = self._boxes[k]
        if self._measured[k]:
            corners = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])
            drawing.polyline(picture, corners, self.colour, closed=True)
        _cross(picture, self._seen(self.places[k : k + 1], self._height, gaze)[0], WHITE)
        _cross(picture, self._seen(self._ahead[k : k + 1], self._height, gaze)[0], self.colour)
        if np.isfinite([x, y]).all():
            text = f"{self.id}  {self._speeds[k] * UNITS[self._units]:.1f} {self._units}"
            drawing.label(picture, text, np.array([x, y - 4.0]), self.colour)

    def _seen(self, places: Array, height: float, gaze: Array) -> Array:
        return self._head.pixels(np.column_stack([places, np.full(len(places), height)]), gaze)


def _cross(picture: Image, at: Array, colour: tuple[int, int, int]) -> None:
    if np.isfinite(at).all() and np.all(np.abs(at) < 1e4):
        cv2.drawMarker(picture, (round(float(at[0])), round(float(at[1]))), colour, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)


def inset(picture: Image, head: Head, gaze: Array, tracks: list[Drawn], frame: int) -> None:
    """Draw the map into the lower right corner: the head, where it looks, and the targets' ways, +Y up."""
    side = int(SHARE * picture.shape[0])
    every = np.concatenate([head.centre[None, :2], *(track.places for track in tracks)])
    low, high = every.min(axis=0) - 1, every.max(axis=0) + 1
    scale = side / float((high - low).max())
    plate = picture[-side:, -side:]
    np.copyto(plate, (plate * 0.35).astype(np.uint8))

    def at(places: Array) -> Array:
        return np.asarray((places - (low + high) / 2) * scale * [1, -1] + side / 2)

    middle = head.ground(head.lens.K[:2, 2], gaze, 0.0)
    if np.isfinite(middle).all():
        drawing.polyline(plate, at(np.stack([head.centre[:2], middle])), WHITE)
    spot = at(head.centre[:2])
    cv2.circle(plate, (round(float(spot[0])), round(float(spot[1]))), 3, WHITE, -1, cv2.LINE_AA)
    for track in tracks:
        upto = int(np.searchsorted(track.frames, frame, side="right"))
        if upto:
            drawing.polyline(plate, at(track.places[:upto]), track.colour)
