"""The annotated video: the footage decoded a second time with the settled tracks drawn on it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from visfuse_cli.maths.cameras import project
from visfuse_cli.maths.polygons import Polygon
from visfuse_cli.maths.speed import KMH
from visfuse_cli.records import Array, Frame, GroundCamera, Image
from visfuse_cli.tracking.camera_watch import CameraLog, Motions
from visfuse_cli.tracking.options import SpeedOptions
from visfuse_cli.tracking.output import box_corners
from visfuse_cli.tracking.privacy import Strangers, parts
from visfuse_cli.vision import drawing
from visfuse_cli.vision.blurring import blur
from visfuse_cli.vision.lens import distort_points
from visfuse_cli.vision.steady import moved

TRAIL_S = 2.0
PLACE_STEP_M = 1.0
PALE, RED = (200, 220, 220), (60, 60, 255)
UNITS = {"km/h": KMH, "mph": 2.2369362920544, "m/s": 1.0}


class _Drawn:
    """One track, ready to be drawn on its frames."""

    def __init__(self, record: dict[str, Any], camera: GroundCamera, config: SpeedOptions) -> None:
        states = record["states"]
        self.first, self.last = states[0]["frame"], states[-1]["frame"]
        self._row = {state["frame"]: k for k, state in enumerate(states)}
        position = np.array([state["position"] for state in states])
        pose = np.column_stack([position, [state["heading"] for state in states]])
        self._corners = box_corners(camera, pose, np.tile(record["summary"]["size"], (len(pose), 1)))
        self._feet = _on_image(camera, position)
        self._measured = [state["measured"] for state in states]
        self._t = np.array([state["t"] for state in states])
        self._private: list[Array] = []
        if config.privacy.blur:
            walks = config.target.motion == "constant-velocity" or record["class"] == "person"
            size = np.array(record["summary"]["size"])
            self._private = parts(camera, pose, size, walks, record["class"] == "two-wheeler")
        units = config.display.units
        summary, factor = record["summary"], UNITS[units]
        half = (summary["speed_ci95"][1] - summary["speed_ci95"][0]) / 2
        self._text = f"{record['id']}  {summary['speed'] * factor:.1f} +-{half * factor:.1f} {units}"
        self._colour = drawing.colour_of(record["id"])
        if summary["rejected"]:
            self._text = f"{record['id']}  rejected"
            self._colour = (150, 150, 150)

    def blurred(self, frame: int) -> list[Array]:
        """Outlines (8, 2) px, with the camera at rest, of what nobody is to recognise in a frame."""
        k = self._row.get(frame)
        return [] if k is None else [part[k] for part in self._private]

    def draw(self, image: Image, frame: int, image_from_rest: Array) -> None:
        k = self._row.get(frame)
        if k is None:
            return
        begin = int(np.searchsorted(self._t, self._t[k] - TRAIL_S))
        corners = moved(image_from_rest, self._corners[k])
        drawing.polyline(image, moved(image_from_rest, self._feet[begin : k + 1]), self._colour)
        drawing.box(image, corners, self._colour, dashed=not self._measured[k])
        if np.isfinite(corners).all():
            corner = corners.min(axis=0)
            drawing.label(image, self._text, corner - [0, 4], self._colour)


def _on_image(camera: GroundCamera, position: Array) -> Array:
    pixels, _ = project(camera, np.column_stack([position, np.zeros(len(position))]))
    return pixels if camera.ground.lens is None else distort_points(pixels, camera.ground.lens)


class _Place:
    """A polygon of ground points (k, 2) m with its name, ready to be drawn on every frame."""

    def __init__(self, name: str, polygon: Array, camera: GroundCamera) -> None:
        ends = np.concatenate([polygon, polygon[:1]])
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ends, axis=0), axis=1))])
        places = np.linspace(0, length[-1], max(2, min(400, round(length[-1] / PLACE_STEP_M))))
        line = _on_image(camera, np.column_stack([np.interp(places, length, ends[:, k]) for k in (0, 1)]))
        size = np.array(camera.image_size)
        shown = np.asarray(np.isfinite(line).all(axis=1) & (np.abs(line) < 3 * size).all(axis=1))
        parts = np.split(np.arange(len(line)), np.flatnonzero(np.diff(shown)) + 1)
        self._name, self._parts = name, [line[part] for part in parts if shown[part[0]]]
        inside = line[shown & (line >= 0).all(axis=1) & (line < size).all(axis=1)]
        self._middle = inside.mean(axis=0) if len(inside) else None

    def draw(self, image: Image, image_from_rest: Array) -> None:
        for part in self._parts:
            drawing.polyline(image, moved(image_from_rest, part), PALE, width=1)
        if self._middle is not None:
            drawing.label(image, self._name, moved(image_from_rest, self._middle), PALE, 0.8)


def annotate(
    frames: Iterable[Frame],
    records: Iterable[dict[str, Any]],
    camera: GroundCamera,
    config: SpeedOptions,
    motions: Motions,
    log: CameraLog,
    strangers: Strangers,
    places: Mapping[str, Polygon],
) -> Iterator[Frame]:
    """Draw the tracks, given in the order of their first frames, on the frames; only the tracks in view are held.

    `places` are polygons on the ground by name: lanes, the region; an empty one is none. Where privacy is asked for,
    `strangers` are blurred as well.
    """
    marked = [_Place(name, np.array(polygon), camera) for name, polygon in places.items() if polygon]
    waiting = iter(records)
    upcoming = next(waiting, None)
    active: list[_Drawn] = []
    for frame in frames:
        while upcoming is not None and upcoming["states"][0]["frame"] <= frame.index:
            active.append(_Drawn(upcoming, camera, config))
            upcoming = next(waiting, None)
        active = [drawn for drawn in active if drawn.last >= frame.index]
        motion = motions.image_from_rest(frame.index)
        here = np.eye(3) if motion is None else motion
        if config.privacy.blur:
            private = [outline for drawn in active for outline in drawn.blurred(frame.index)]
            private += strangers.outlines(frame.index)
            blur(frame.image, (moved(here, outline) for outline in private))
        for place in marked:
            place.draw(frame.image, here)
        for drawn in active:
            drawn.draw(frame.image, frame.index, here)
        mark_camera(frame, log)
        yield frame


def mark_camera(frame: Frame, log: CameraLog) -> None:
    """Write the time, and what is known of the camera; a frame in red is not measured."""
    high, wide = frame.image.shape[:2]
    note, colour = f"{frame.t:.2f} s", (230, 230, 230)
    if log.was_lost(frame.t):
        note, colour = f"{note}  scene not recognised: not measured", RED
        border = np.array([[0, 0], [wide - 1, 0], [wide - 1, high - 1], [0, high - 1]], dtype=float)
        drawing.polyline(frame.image, border, RED, closed=True, width=max(4, high // 90))
    elif (move := log.last_move(frame.t)) is not None:
        note = f"{note}  camera moved by {move['px']:.1f} px at {move['t']:.1f} s: registered"
    drawing.label(frame.image, note, np.array([4.0, high]), colour)
