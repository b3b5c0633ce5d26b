"""`visfuse speed`: one fixed camera, a ground homography, and the speed of everything that moves.

frames -> background -> regions -> tracker (predict, measure, update) -> conclude -> judge -> tables and video
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from visfuse_cli.config import Section
from visfuse_cli.errors import InputError
from visfuse_cli.files import detections as detection_files
from visfuse_cli.files import homography as homography_files
from visfuse_cli.files.run_json import write_run_json
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video import VideoSource, is_clip_folder, list_clips, open_source
from visfuse_cli.maths.cameras import ground_camera
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Array, Frame, GroundCamera, Region, RunRequest, RunResult
from visfuse_cli.tracking.annotate import annotate
from visfuse_cli.tracking.conclude import conclude
from visfuse_cli.tracking.ground import Abandoned, GroundTracker, Track
from visfuse_cli.tracking.output import abandoned_row, lane_of, row_of, track_record
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.verdict import SpeedSettings, judge
from visfuse_cli.vision import regions as region_tools
from visfuse_cli.vision.background import Background, median_picture

Polygon = tuple[tuple[float, float], ...]


class VideoSettings(Section):
    """Where times come from when the footage carries none."""

    fps: float | None = Field(None, gt=0, le=10000, description="frames/s of an image folder without timestamps.csv")


class BackgroundSettings(Section):
    """The adaptive background."""

    model: Literal["mog2", "knn"] = Field("mog2", description="mog2: mixture of Gaussians; knn: nearest neighbours")
    threshold: float = Field(16.0, gt=0, le=1000, description="squared distance (variances) of a foreground pixel")
    memory_s: float = Field(60.0, gt=0, le=36000, description="s: how long the background remembers")
    shadow_ratio: float = Field(0.45, gt=0, lt=1, description="darkest a shadow may be, as a share of the lit ground")
    warmup_s: float = Field(12.0, ge=0, le=600, description="s: the empty scene is the median over this much footage")


class RegionSettings(Section):
    """Cleaning of the foreground, in metres at the scale of the ground."""

    gap: float = Field(0.35, ge=0, le=5, description="m: gaps up to this size are closed")
    speck: float = Field(0.12, ge=0, le=5, description="m: specks below this size are removed")


class DisplaySettings(Section):
    """Annotation and screen only; tables keep their units."""

    units: Literal["km/h", "mph", "m/s"] = Field("km/h", description="unit of speed on the video and the screen")


class SpeedConfig(TrackerSettings):
    """Configuration of `visfuse speed`."""

    video: VideoSettings = VideoSettings()
    background: BackgroundSettings = BackgroundSettings()
    regions: RegionSettings = RegionSettings()
    speed: SpeedSettings = SpeedSettings()
    lanes: tuple[Polygon, ...] = Field((), description="polygons of ground points [X, Y] m, numbered from 1")
    display: DisplaySettings = DisplaySettings()

    @field_validator("lanes")
    @classmethod
    def _polygons(cls, lanes: tuple[Polygon, ...]) -> tuple[Polygon, ...]:
        for number, polygon in enumerate(lanes, start=1):
            if len(polygon) < 3:
                raise ValueError(f"lane {number} has {len(polygon)} corners; a polygon needs three or more")
        return lanes
