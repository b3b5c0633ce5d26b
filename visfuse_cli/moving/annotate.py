"""Both views side by side with the targets' boxes, and a small map of the camera's way and theirs."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from visfuse_cli.maths.planes import in_right, projected
from visfuse_cli.moving.head import Head
from visfuse_cli.records import Array, Image, StereoRig
from visfuse_cli.vision import drawing

UNITS = {"km/h": 3.6, "mph": 2.2369362920544, "m/s": 1.0}
SHARE = 0.3  # of the picture's height: side of the map
WHITE = (255, 255, 255)
OUT_OF_SIGHT = [np.nan] * 4


class Drawn:
    """What is drawn of one settled track of tracks.json."""

    def __init__(self, record: dict[str, Any], units: str) -> None:
        self.id = int(record["id"])
        self.frames, self.places, self._speeds, self._measured = (
            np.array([state[name] for state in record["states"]]) for name in ("frame", "position", "speed", "measured")
        )
        self._boxes = {
            view: np.array([state["box"].get(view, OUT_OF_SIGHT) for state in record["states"]])
            for view in ("left", "right")
        }
        self._size, self._units = np.array(record["summary"]["size"]), units
        self.colour = drawing.colour_of(self.id)

    def draw(self, pictures: dict[str, Image], frame: int, rig: StereoRig, head: Head) -> None:
        """Draw one frame: the box as it was measured, and in white the one that the 3D estimate projects to."""
        k = int(np.searchsorted(self.frames, frame))
        if k == len(self.frames) or self.frames[k] != frame:
            return
        place = head.inside(self.places[k])
        half = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2 * [*self._size, 0]
        for view, image in pictures.items():
            if place[2] > 0.2:
                corners = place + half
                shown = corners if view == "left" else in_right(rig, corners)
                lens = rig.left if view == "left" else rig.right
                drawing.polyline(image, projected(lens.K, shown), WHITE, closed=True)
            x, y, w, h = box = self._boxes[view][k]
            if self._measured[k] and np.isfinite(box).all():
                drawing.polyline(image, np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]]), self.colour, True)
                text = f"{self.id}  {self._speeds[k] * UNITS[self._units]:.1f} {self._units}"
                drawing.label(image, text, np.array([x, y - 4.0]), self.colour)


def inset(picture: Image, ego: Array, tracks: list[Drawn], frame: int, now: int) -> None:
    """Draw the map into the lower right corner: the camera's way (n, 3) so far and the targets', seen from above."""
    side = int(SHARE * picture.shape[0])
    every = np.concatenate([ego, *(track.places for track in tracks)])[:, [0, 2]]
    low, high = every.min(axis=0) - 1, every.max(axis=0) + 1
    scale = side / float((high - low).max())
    plate = picture[-side:, -side:]
    np.copyto(plate, (plate * 0.35).astype(np.uint8))

    def at(places: Array) -> Array:
        return (places[:, [0, 2]] - (low + high) / 2) * scale * [1, -1] + side / 2

    drawing.polyline(plate, at(ego[: now + 1]), WHITE)
    spot = at(ego[now : now + 1])[0]
    cv2.circle(plate, (round(float(spot[0])), round(float(spot[1]))), 3, WHITE, -1, cv2.LINE_AA)
    for track in tracks:
        upto = int(np.searchsorted(track.frames, frame, side="right"))
        if upto:
            drawing.polyline(plate, at(track.places[:upto]), track.colour)


def together(left: Image, right: Image) -> Image:
    """Both views side by side, of even size."""
    high = left.shape[0] // 2 * 2
    wide = left.shape[1] // 2 * 2
    return np.asarray(np.hstack([left[:high, :wide], right[:high, :wide]]), np.uint8)
