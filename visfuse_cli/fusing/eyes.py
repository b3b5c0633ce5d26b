"""What looks at each set of frames, be it pictures or boxes from outside: one face for both."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.box_watch import BoxWatch
from visfuse_cli.fusing.picture_watch import Camera, PictureWatch
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.fusing.tracker import Newcomer, Tracker
from visfuse_cli.fusing.visibility import visibility
from visfuse_cli.maths import multiview
from visfuse_cli.records import Array, Frame, FrameSet, Gaussian, Image, Sighting, View
from visfuse_cli.threads import thread_cap
from visfuse_cli.vision.empty import empty_picture
from visfuse_cli.vision.straighten import Straight

WARMUP_PICTURES = 41
THREADS = 2  # cameras looked at at once; OpenCV works outside of the interpreter


class Footage(Protocol):
    """A camera's frames, as often as they are asked for."""

    nominal_rate: float
    frame_count: int | None

    def frames(self) -> Iterator[Frame]:
        """All frames in order."""


class Eyes(Protocol):
    """What is asked of both kinds: cameras P (C, 3, 4) to the pixels they measure in, and picture sizes (C, 2) px."""

    P: Array
    sizes: Array
    zoom: Array  # (C,): pixels of the footage per pixel measured in
    open: NDArray[np.bool_]  # (C,): which cameras are in the latest set

    def restart(self) -> None:
        """Forget what was learnt since the beginning."""

    def detect(self, instant: FrameSet) -> None:
        """Look at a set of frames."""

    def alone(self, camera: int, frame: Frame) -> Array:
        """Where on the ground (k, 2) m one camera's frame alone puts people."""

    def look(self, tracker: Tracker) -> list[dict[int, Sighting]]:
        """Sightings of everybody followed."""

    def newcomers(self, tracker: Tracker) -> list[Newcomer]:
        """Who is seen and not followed yet."""

    def visible(self, beliefs: Gaussian) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which pictures hold each person's middle (T, C), and which give a clear sight of it (T, C)."""

    def learn(self, t: float, tracker: Tracker) -> None:
        """Adapt to the latest set."""


class BoxEyes:
    """Boxes of an external detector, [x, y, w, h, score] (n, 5) px by frame, for each camera."""

    def __init__(self, views: list[View], boxes: list[dict[int, Array]], config: FuseConfig) -> None:
        self.P = np.stack([multiview.projection(view) for view in views])
        self.sizes = np.array([view.size for view in views], dtype=float)
        self.zoom = np.ones(len(views))
        self.open = np.zeros(len(views), dtype=bool)
        self._names, self._config = [view.name for view in views], config
        self._boxes = boxes
        self._watch = BoxWatch(views, self.P, config)
        self._now: dict[int, Array] = {}
        self._dt: dict[int, float] = {}

    def restart(self) -> None:
        """Boxes from outside are never learnt from."""

    def detect(self, instant: FrameSet) -> None:
        """Take the boxes of a set's frames."""
        found = _frames(self._names, instant)
        self.open = np.isin(np.arange(len(self._names)), list(found))
        self._dt = {camera: frame.t - instant.t for camera, frame in found.items()}
        rows = {camera: self._boxes[camera].get(frame.index) for camera, frame in found.items()}
        self._now = {camera: boxes for camera, boxes in rows.items() if boxes is not None}

    def alone(self, camera: int, frame: Frame) -> Array:
        """Where on the ground (k, 2) m one camera's boxes alone put people."""
        boxes = self._boxes[camera].get(frame.index)
        return np.zeros((0, 2)) if boxes is None else self._watch.places(camera, boxes)

    def look(self, tracker: Tracker) -> list[dict[int, Sighting]]:
        """Sightings of everybody followed."""
        return self._watch.look(self._now, self._dt, tracker)

    def newcomers(self, tracker: Tracker) -> list[Newcomer]:
        """Who is seen and not followed yet."""
        return self._watch.newcomers(tracker)

    def visible(self, beliefs: Gaussian) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which pictures hold each person's middle (T, C), and which give a clear sight of it (T, C)."""
        return visibility(beliefs, self.sizes, self.P, self._config)

    def learn(self, t: float, tracker: Tracker) -> None:
        """Boxes from outside need no background."""


class PictureEyes:
    """The pictures themselves; the empty scenes are found in the first `background.warmup_s` of the footage."""

    def __init__(self, views: list[View], footage: list[Any], config: FuseConfig) -> None:
        straight = [Straight(view, config.sight.pixels) for view in views]
        with ThreadPoolExecutor(min(THREADS, thread_cap() or THREADS)) as pool:
            empty = list(pool.map(_empty, straight, footage, [config.background.warmup_s] * len(views)))
        self._cameras = [Camera(each, picture, config) for each, picture in zip(straight, empty, strict=True)]
        self.P = np.stack(
            [each.K @ np.column_stack([view.R, view.t]) for each, view in zip(straight, views, strict=True)]
        )
        self._outside = [each.outside for each in straight]
        self.sizes = np.array([each.size for each in straight], dtype=float)
        self.zoom = np.array([view.size[0] / each.small[0] for each, view in zip(straight, views, strict=True)])
        self.open = np.zeros(len(views), dtype=bool)
        self._names, self._config = [view.name for view in views], config
        self._watch = PictureWatch(self._cameras, self.P, config)
        self._dt: dict[int, float] = {}
        self._pool = ThreadPoolExecutor(min(THREADS, thread_cap() or THREADS))

    def restart(self) -> None:
        """Begin again with the empty scenes as backgrounds."""
        for camera in self._cameras:
            camera.restart()

    def detect(self, instant: FrameSet) -> None:
        """Find out what moves in each picture of a set."""
        found = _frames(self._names, instant)
        self.open = np.isin(np.arange(len(self._names)), list(found))
        self._dt = {camera: frame.t - instant.t for camera, frame in found.items()}
        list(self._pool.map(lambda pair: self._cameras[pair[0]].look(pair[1].image), found.items()))
        self._watch.settle(list(found))

    def alone(self, camera: int, frame: Frame) -> Array:
        """Where on the ground (k, 2) m what moves in one camera's frame alone puts people."""
        self._cameras[camera].look(frame.image)
        return self._watch.places(camera)

    def look(self, tracker: Tracker) -> list[dict[int, Sighting]]:
        """Sightings of everybody followed."""
        return self._watch.look(self._dt, tracker)

    def newcomers(self, tracker: Tracker) -> list[Newcomer]:
        """Who is seen and not followed yet."""
        return self._watch.newcomers(tracker)

    def visible(self, beliefs: Gaussian) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which pictures hold each person's middle (T, C), and which give a clear sight of it (T, C)."""
        return visibility(beliefs, self.sizes, self.P, self._config, self._outside)

    def learn(self, t: float, tracker: Tracker) -> None:
        """Let the backgrounds adapt where nobody is."""
        boxes = self._watch.followed(tracker)
        list(self._pool.map(lambda camera: self._cameras[camera].learn(t, boxes[camera]), self._dt))


def _frames(names: list[str], instant: FrameSet) -> dict[int, Frame]:
    return {camera: instant.frames[name] for camera, name in enumerate(names) if name in instant.frames}


def _empty(straight: Straight, footage: Footage, warmup_s: float) -> Image:
    """The scene without people, from pictures spread over the first `warmup_s` seconds."""
    span = warmup_s * footage.nominal_rate
    if footage.frame_count is not None:
        span = min(span, footage.frame_count)
    step = max(1, int(span / WARMUP_PICTURES))
    pictures: list[Image] = []
    first: float | None = None
    for number, frame in enumerate(footage.frames()):
        first = frame.t if first is None else first
        if pictures and frame.t - first >= warmup_s:
            break
        if number % step == 0:
            pictures.append(straight.picture(frame.image))
    return empty_picture(pictures)
