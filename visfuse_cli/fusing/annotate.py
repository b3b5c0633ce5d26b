"""The annotated footage: settled tracks drawn on every camera's pictures, and on a map seen from above."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from visfuse_cli.fusing.visibility import expected_boxes
from visfuse_cli.maths.multiview import project, projection
from visfuse_cli.records import Array, Image, View
from visfuse_cli.vision import drawing
from visfuse_cli.vision.lens import distort_points

TRAIL_S = 2.0
UNITS = {"km/h": 3.6, "mph": 2.2369362920544, "m/s": 1.0}
MAP_PX = 720  # side of the map
MARGIN_M = 1.0  # of the map around cameras and people
TILE_PX = 640  # width of a camera's picture in the mosaic
WIDTH = 0.5  # m: width of a box that was predicted


class Drawn:
    """One settled track, ready to be drawn; places are brought to the ground's frame, x_ground = R x_world + t."""

    def __init__(self, record: dict[str, Any], R: Array, t: Array, units: str, centroid: bool) -> None:
        states = record["states"]
        self.id = int(record["id"])
        self.first, self.last = int(states[0]["frame"]), int(states[-1]["frame"])
        self._row = {int(state["frame"]): k for k, state in enumerate(states)}
        self.t = np.array([state["t"] for state in states])
        self.foot = np.array([state["position"] for state in states]) @ R.T + t
        self.height = float(record["summary"]["height"])
        if centroid:
            self.foot[:, 2] -= self.height / 2
        self.boxes: list[dict[str, list[float]]] = [state["box"] for state in states]
        self._speed = [state["speed"] * UNITS[units] for state in states]
        self._units = units
        self.colour = drawing.colour_of(self.id)

    def row(self, frame: int) -> int | None:
        """Where in the track a frame is."""
        return self._row.get(frame)

    def trail(self, k: int) -> Array:
        """The feet (n, 3) m of the last seconds before row k."""
        return np.asarray(self.foot[int(np.searchsorted(self.t, self.t[k] - TRAIL_S)) : k + 1])

    def label(self, k: int) -> str:
        """Id and present speed."""
        return f"{self.id}  {self._speed[k]:.1f} {self._units}"


def active(tracks: Iterable[Drawn], frames: Iterable[int]) -> Iterator[list[tuple[Drawn, int]]]:
    """For each frame, the tracks that are in it with their rows; tracks come in the order of their first frames."""
    waiting = iter(tracks)
    upcoming = next(waiting, None)
    held: list[Drawn] = []
    for frame in frames:
        while upcoming is not None and upcoming.first <= frame:
            held.append(upcoming)
            upcoming = next(waiting, None)
        held = [track for track in held if track.last >= frame]
        yield [(track, k) for track in held if (k := track.row(frame)) is not None]


def draw_view(image: Image, view: View, people: list[tuple[Drawn, int]], t: float) -> None:
    """Draw people on one camera's picture: measured boxes, dashed predicted ones, trails of the feet."""
    P = projection(view)
    for track, k in people:
        drawing.polyline(image, _on_picture(view, P, track.trail(k)), track.colour)
        shown = track.boxes[k].get(view.name)
        box = None if shown is not None else _predicted(view, P, track, k)
        if shown is not None:
            box = np.array(shown) + [0, 0, shown[0], shown[1]]
        if box is None:
            continue
        _rectangle(image, box, track.colour, dashed=shown is None)
        drawing.label(image, track.label(k), box[:2] - [0, 4], track.colour)
    drawing.label(image, f"{view.name}  {t:.2f} s", np.array([4.0, image.shape[0]]), (230, 230, 230))


def _on_picture(view: View, P: Array, points: Array) -> Array:
    """Footage pixels (n, 2) of points (n, 3); NaN where they are behind the camera."""
    pixels, _ = project(P, points)
    good = np.isfinite(pixels).all(axis=1)
    if np.any(view.lens.D) and good.any():
        pixels[good] = distort_points(pixels[good], view.lens)
    return pixels


def _predicted(view: View, P: Array, track: Drawn, k: int) -> Array | None:
    """The box [u0, v0, u1, v1] (4,) px in which somebody should be; None outside of the picture."""
    each = np.array([track.height]), np.array([WIDTH])
    box = expected_boxes(P[None], track.foot[k : k + 1], *each)[0, 0]
    if not np.isfinite(box).all():
        return None
    if np.any(view.lens.D):
        box = distort_points(box.reshape(2, 2), view.lens).ravel()
    wide, high = view.size
    inside = box[2] > 0 and box[3] > 0 and box[0] < wide and box[1] < high and box[2] - box[0] < 2 * wide
    return np.asarray(box) if inside else None


def _rectangle(image: Image, box: Array, colour: tuple[int, int, int], dashed: bool) -> None:
    u0, v0, u1, v1 = box
    corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1], [u0, v0]])
    if not dashed:
        drawing.polyline(image, corners, colour)
        return
    for a, b in pairwise(corners):
        cuts = a + (b - a) * np.linspace(0, 1, 10)[:, None]
        for k in range(0, 9, 2):
            drawing.polyline(image, cuts[k : k + 2], colour)


class GroundPlan:
    """A map from above: cameras, a grid of metres, and people on it; `places` (n, 2) m are what it must hold."""

    def __init__(self, views: list[View], places: Array) -> None:
        centres = np.array([view.centre[:2] for view in views])
        held = np.concatenate([centres, places]) if len(places) else centres
        low, high = held.min(axis=0) - MARGIN_M, held.max(axis=0) + MARGIN_M
        self._middle, side = (low + high) / 2, float((high - low).max())
        self._scale = MAP_PX / side
        self._empty = np.full((MAP_PX, MAP_PX, 3), 32, np.uint8)
        step = next(s for s in (1, 2, 5, 10, 20, 50, 100, 1000, 10**9) if side / s <= 16)
        for k in range(int(np.floor((self._middle.min() - side) / step)), int((self._middle.max() + side) / step) + 2):
            for line in ([[k * step, -1e4], [k * step, 1e4]], [[-1e4, k * step], [1e4, k * step]]):
                drawing.polyline(self._empty, self.at(np.array(line, dtype=float)), (52, 52, 52), width=1)
        for view, centre in zip(views, centres, strict=True):
            ahead = view.R[2, :2] / max(float(np.linalg.norm(view.R[2, :2])), 1e-9)
            aside = np.array([-ahead[1], ahead[0]])
            wedge = centre + side / 22 * np.stack([0 * ahead, ahead + 0.5 * aside, ahead - 0.5 * aside])
            drawing.polyline(self._empty, self.at(wedge), (200, 200, 200), closed=True)
            drawing.label(self._empty, view.name, self.at(centre[None])[0], (200, 200, 200), 0.8)
        drawing.label(self._empty, f"grid {step} m", np.array([4.0, MAP_PX]), (200, 200, 200), 0.8)

    def at(self, places: Array) -> Array:
        """Map pixels (n, 2) of places (n, 2) m: x to the right, y upwards."""
        return np.asarray((places - self._middle) * self._scale * [1, -1] + MAP_PX / 2)

    def now(self, people: list[tuple[Drawn, int]]) -> Image:
        """The map at one instant."""
        picture = self._empty.copy()
        for track, k in people:
            drawing.polyline(picture, self.at(track.trail(k)[:, :2]), track.colour)
            place = self.at(track.foot[k : k + 1, :2])[0]
            _dot(picture, place, track.colour)
            drawing.label(picture, str(track.id), place + [8, 4], track.colour, 0.8)
        return picture

    def whole(self, tracks: Iterable[Drawn]) -> Image:
        """The map of all tracks over time, a mark every few seconds."""
        picture = self._empty.copy()
        for track in tracks:
            drawing.polyline(picture, self.at(track.foot[:, :2]), track.colour)
            place = self.at(track.foot[:, :2])
            duration = float(track.t[-1] - track.t[0])
            every = next((s for s in (1, 2, 5, 10, 30, 60, 300, 1800) if duration / s <= 8), 3600)
            for second in np.arange(np.ceil(track.t[0] / every), np.floor(track.t[-1] / every) + 1) * every:
                k = min(int(np.searchsorted(track.t, second)), len(track.t) - 1)
                _dot(picture, place[k], track.colour, 3)
                drawing.label(picture, f"{second:g}", place[k] + [4, -2], track.colour, 0.6)
            drawing.label(picture, f"{track.id}: {track.t[0]:.1f} s", place[0] + [6, 10], track.colour, 0.7)
        return picture


def _dot(picture: Image, at: Array, colour: tuple[int, int, int], radius: int = 6) -> None:
    cv2.circle(picture, (round(float(at[0])), round(float(at[1]))), radius, colour, -1, cv2.LINE_AA)


def mosaic_size(views: list[View]) -> tuple[int, int]:
    """Width and height px of the mosaic of all cameras and the map."""
    columns, tile = _tiles(views)
    rows = -(-(len(views) + 1) // columns)
    return columns * tile[0], rows * tile[1]


def mosaic(views: list[View], pictures: dict[str, Image], plan: Image) -> Image:
    """All cameras' pictures, dark where one is missing, and the map beside them."""
    columns, (wide, high) = _tiles(views)
    size = mosaic_size(views)
    canvas = np.zeros((size[1], size[0], 3), np.uint8)
    shown = [pictures.get(view.name) for view in views] + [plan]
    for number, picture in enumerate(shown):
        if picture is None:
            continue
        scale = min(wide / picture.shape[1], high / picture.shape[0])
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)[:high, :wide]
        u, v = number % columns * wide, number // columns * high
        u, v = u + (wide - small.shape[1]) // 2, v + (high - small.shape[0]) // 2
        canvas[v : v + small.shape[0], u : u + small.shape[1]] = small
    return canvas


def _tiles(views: list[View]) -> tuple[int, tuple[int, int]]:
    """Columns of the mosaic, and the even size of a tile."""
    wide, high = np.max([view.size for view in views], axis=0)
    scale = min(1.0, TILE_PX / max(wide, high))
    count = len(views) + 1
    # The arrangement whose picture is nearest to 16:9.
    columns = min(range(1, count + 1), key=lambda n: abs(np.log(n * wide / (-(-count // n) * high) / (16 / 9))))
    return columns, (int(wide * scale) // 2 * 2, int(high * scale) // 2 * 2)
