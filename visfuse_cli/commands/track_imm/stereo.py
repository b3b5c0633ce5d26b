"""The moving stereo head: pairs of frames and poses -> straight pictures -> targets -> settled tracks -> video."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from visfuse_cli.commands.track_imm.scene import (
    check_covered,
    check_inside,
    check_kind,
    check_size,
    named_targets,
    open_views,
)
from visfuse_cli.errors import InputError
from visfuse_cli.files.scene import file, view
from visfuse_cli.files.sensors import Sensors
from visfuse_cli.files.stereo_calibration import FILES, read_rig
from visfuse_cli.files.video import VideoSource
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.moving.annotate import Drawn, inset, together
from visfuse_cli.moving.conclude import conclude, track_record
from visfuse_cli.moving.journey import Ride, journey
from visfuse_cli.moving.models import INDEX
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.moving.target import Target
from visfuse_cli.moving.tracker import Tracker
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, FrameSet, Image, Lens, RunRequest, StereoRig
from visfuse_cli.vision.lens import undistort_points

VIEWS = ("left", "right")
AGREE = 0.5  # of the rate's interval, within which two frames make a pair


class StereoRun:
    """One run over a stereo scene; raises InputError on bad input before the first frame."""

    frame_of_reference = "left-camera-at-start"

    def __init__(self, request: RunRequest, sensor_file: Path, sensors: Sensors) -> None:
        folder = request.input
        self._config: ImmConfig = request.config
        check_kind(self._config.filter.kind, tuple(INDEX), "stereo")
        self._sensor_file, self.sensors = sensor_file, sensors
        calibration = file(folder, FILES, "calibration of the pair")
        self._rig = read_rig(calibration)
        self.views = {name: view(folder, name) for name in VIEWS}
        init, given = named_targets(folder)
        self.files = [path for path in (calibration, sensor_file, init) if path is not None]
        self._given = [
            replace(
                each, left=undistort_points(each.left, self._rig.left), right=_straight(each.right, self._rig.right)
            )
            for each in given
        ]
        sizes = {name: (source.width, source.height) for name, source in open_views(self.views, request).items()}
        if sizes["left"] != sizes["right"]:
            left, right = ("x".join(map(str, sizes[name])) for name in VIEWS)
            raise InputError(f"{folder}: left is {left} and right is {right}; both views need one size")
        self._size = sizes["left"]
        for name, lens in (("M1", self._rig.left), ("M2", self._rig.right)):
            check_size(calibration, name, lens, self._size, self._rig.image_size)
        check_inside(init, self._given, self._size)
        self._ride = Ride(journey(sensors.form, sensors.columns, self._config.odometry))
        self._straighten = _Pictures(self._rig, self._size)

    def follow(self, sources: dict[str, VideoSource], run_: Run) -> Iterator[dict[str, Any] | None]:
        """The record of every target that was followed, None for one that does not count."""
        tracker = Tracker(self._rig, self._config, self._size, self._given, run_.stage)
        for pair in _pairs(sources, run_):
            check_covered(self._sensor_file, self.sensors, pair.t)
            run_.count("frames")
            frame = pair.frames["left"].index
            head = self._ride.look(frame, pair.t)
            with run_.stage("straighten"):
                pictures = self._straighten.straight(pair)
            for target in tracker.step(pictures, frame, head):
                yield self._settled(target)
        for target in tracker.finish():
            yield self._settled(target)
        for text in tracker.missed:
            run_.warn(text)
        if not run_.counts["frames"] and run_.stopped_by is None:
            raise InputError(f"{self.views['left'].parent}: no frame of one view is near in time to one of the other")

    def audited(self, frames: dict[str, int]) -> str | None:
        """What is to be said of the numbers of frames by view."""
        if frames["left"] == frames["right"]:
            return None
        return f"the views have {' and '.join(f'{frames[name]} ({name})' for name in VIEWS)} frames; pairs go by time"

    def extra(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """What the summary and run.json hold besides."""
        kept = self._ride.kept()
        driven = float(np.sum(np.linalg.norm(np.diff(kept["T"], axis=0), axis=1)))
        ego = {
            "frame": kept["frame"].tolist(),
            "position": kept["T"].round(6).tolist(),
            "rotation": kept["R"].round(9).tolist(),  # x_world = rotation x_camera + position
        }
        return {"ego_distance": driven}, {"ego": ego}

    def draw(self, sources: dict[str, VideoSource], records: Iterable[dict[str, Any]], path: Path, run_: Run) -> None:
        """Write both views side by side with a map, from a second decode."""
        tracks = [Drawn(record, self._config.display.units) for record in records]
        ego = self._ride.kept()
        wide, high = 2 * (self._size[0] // 2 * 2), self._size[1] // 2 * 2
        rate = sources["left"].nominal_rate
        with VideoWriter(path, wide, high, rate) as writer, run_.background(writer) as out:
            for pair in _pairs(sources, run_):
                frame, head = pair.frames["left"].index, self._ride.head(pair.t)
                pictures = {name: picture.copy() for name, picture in self._straighten.straight(pair).items()}
                for track in tracks:
                    track.draw(pictures, frame, self._rig, head)
                picture = together(pictures["left"], pictures["right"])
                inset(picture, ego["T"], tracks, frame, int(np.searchsorted(ego["frame"], frame)))
                out.write(picture, pair.t)

    def _settled(self, target: Target) -> dict[str, Any] | None:
        path = conclude(target, self._ride)
        return None if path is None else track_record(path)


def _straight(quad: Array | None, lens: Lens) -> Array | None:
    return None if quad is None else undistort_points(quad, lens)


def _pairs(sources: dict[str, VideoSource], run_: Run) -> Iterator[FrameSet]:
    tolerance = AGREE / max(source.nominal_rate for source in sources.values())
    alone = 0
    for pair in run_.synchronise(sources, tolerance):
        if pair.missing:
            alone += 1
        else:
            yield pair
    if alone:
        run_.warn(f"{alone} left frames have no right one within {tolerance:.3f} s; they are left out")


class _Pictures:
    """Straight pictures of both views, on the calibration's K."""

    def __init__(self, rig: StereoRig, size: tuple[int, int]) -> None:
        self._maps = {
            name: cv2.initUndistortRectifyMap(lens.K, lens.D, np.eye(3), lens.K, size, cv2.CV_16SC2)
            for name, lens in (("left", rig.left), ("right", rig.right))
            if np.any(lens.D)
        }

    def straight(self, pair: FrameSet) -> dict[str, Image]:
        """Both views (H, W, 3) of a pair."""
        return {
            name: np.asarray(cv2.remap(pair.frames[name].image, *self._maps[name], cv2.INTER_LINEAR), np.uint8)
            if name in self._maps
            else pair.frames[name].image
            for name in VIEWS
        }
