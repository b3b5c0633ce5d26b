"""The pan-tilt head over the ground: frames and angles -> straight pictures -> targets -> settled tracks -> video."""

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
from visfuse_cli.files import homography
from visfuse_cli.files.lens_files import read_lens
from visfuse_cli.files.scene import file, find_view, view
from visfuse_cli.files.sensors import Sensors
from visfuse_cli.files.stereo_calibration import FILES
from visfuse_cli.files.video import VideoSource
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.gazing.annotate import Drawn, inset
from visfuse_cli.gazing.conclude import conclude
from visfuse_cli.gazing.head import rest
from visfuse_cli.gazing.models import KINDS
from visfuse_cli.gazing.tracker import Tracker
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, Frame, Image, RunRequest
from visfuse_cli.vision.lens import undistort_points

HOMOGRAPHY = "homography.json"


class PanTiltRun:
    """One run over a pan-tilt scene; raises InputError on bad input before the first frame."""

    frame_of_reference = "ground"

    def __init__(self, request: RunRequest, sensor_file: Path, sensors: Sensors) -> None:
        folder = request.input
        self._config: ImmConfig = request.config
        check_kind(self._config.filter.kind, tuple(KINDS), "pan-tilt")
        self._sensor_file, self.sensors = sensor_file, sensors
        self.views = {"left": view(folder, "left")}
        calibration = file(folder, FILES, "calibration of the camera (M1, D1)")
        self._lens, stated = read_lens(calibration)
        path = request.options.get("homography") or file(
            folder, (HOMOGRAPHY,), "homography for the gaze angles of sensors.csv"
        )
        init, given = named_targets(folder)
        self.files = [each for each in (calibration, sensor_file, path, init) if each is not None]
        source = open_views(self.views, request)["left"]
        self._size = (source.width, source.height)
        check_size(calibration, "M1", self._lens, self._size, stated)
        self._given = [replace(each, left=undistort_points(each.left, self._lens)) for each in given]
        check_inside(init, self._given, self._size)
        self._ground, self._rest = rest(
            homography.read(path), self._lens, self._config.gaze.order, str(path), self._size
        )
        self._spare = find_view(folder, "right")
        straight = np.eye(3), self._lens.K, self._size, cv2.CV_16SC2
        self._maps = (
            cv2.initUndistortRectifyMap(self._lens.K, self._lens.D, *straight) if np.any(self._lens.D) else None
        )

    def follow(self, sources: dict[str, VideoSource], run_: Run) -> Iterator[dict[str, Any] | None]:
        """The record of every target that was followed, None for one that does not count."""
        if self._spare is not None:
            run_.warn(f"{self._spare}: is not looked at; with gaze angles one view is all that is used")
        tracker = Tracker(self._rest, self._config, self._size, self._given, run_.stage)
        for frame in run_.frames(sources["left"]):
            check_covered(self._sensor_file, self.sensors, frame.t)
            run_.count("frames")
            for target in tracker.step(self._straight(frame), frame.index, frame.t, self._gaze(frame.t)):
                yield conclude(target, self._ground)
        for target in tracker.finish():
            yield conclude(target, self._ground)
        for text in tracker.missed:
            run_.warn(text)
        if not run_.counts["frames"] and run_.stopped_by is None:
            raise InputError(f"{self.views['left']}: has no frame to look at")

    def audited(self, frames: dict[str, int]) -> str | None:
        """One view agrees with itself."""
        return None

    def extra(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """What the summary and run.json hold besides."""
        return {}, {"head": {"position": self._rest.centre.tolist()}}

    def draw(self, sources: dict[str, VideoSource], records: Iterable[dict[str, Any]], path: Path, run_: Run) -> None:
        """Write the view with a map of the ground, from a second decode."""
        tracks = [Drawn(record, self._rest, self._config) for record in records]
        wide, high = self._size[0] // 2 * 2, self._size[1] // 2 * 2
        source = sources["left"]
        with VideoWriter(path, wide, high, source.nominal_rate) as writer, run_.background(writer) as out:
            for frame in run_.frames(source):
                picture, gaze = self._straight(frame)[:high, :wide].copy(), self._gaze(frame.t)
                for track in tracks:
                    track.draw(picture, frame.index, gaze)
                inset(picture, self._rest, gaze, tracks, frame.index)
                out.write(picture, frame.t)

    def _gaze(self, t: float) -> Array:
        """Elevation and vergence (2,) rad at t (s), linear between samples."""
        columns = self.sensors.columns
        return np.array([np.interp(t, columns["t"], columns[name]) for name in ("elevation", "vergence")])

    def _straight(self, frame: Frame) -> Image:
        if self._maps is None:
            return frame.image
        return np.asarray(cv2.remap(frame.image, *self._maps, cv2.INTER_LINEAR), np.uint8)
