"""What `visfuse speed` can be told about a road and what it shows of it, beside the tracker's own settings."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from visfuse_cli.config import Section
from visfuse_cli.maths.polygons import Polygon, surrounding
from visfuse_cli.tracking.foreground import RegionSettings
from visfuse_cli.tracking.lanes import LaneSettings
from visfuse_cli.tracking.lookout import BackgroundSettings
from visfuse_cli.tracking.privacy import PrivacySettings
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.verdict import SpeedSettings


class DisplaySettings(Section):
    """Annotation and screen only; tables keep their units."""

    units: Literal["km/h", "mph", "m/s"] = Field("km/h", description="unit of speed on the video and the screen")


class SpeedOptions(TrackerSettings):
    """All that does not say where footage and its times come from."""

    background: BackgroundSettings = BackgroundSettings()
    regions: RegionSettings = RegionSettings()
    speed: SpeedSettings = SpeedSettings()
    lanes: tuple[Polygon, ...] = Field((), description="polygons of ground points [X, Y] m, numbered from 1")
    lanes_file: Path | None = Field(
        None, description="lanes.yaml of an earlier run; lanes found are written to it where it does not exist yet"
    )
    lane_finding: LaneSettings = LaneSettings()
    display: DisplaySettings = DisplaySettings()
    privacy: PrivacySettings = PrivacySettings()

    @field_validator("lanes")
    @classmethod
    def _polygons(cls, lanes: tuple[Polygon, ...]) -> tuple[Polygon, ...]:
        for number, polygon in enumerate(lanes, start=1):
            surrounding(polygon, f"lane {number}")
        return lanes

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.lanes and self.lanes_file is not None:
            raise ValueError("lanes and lanes_file are both given; one of them is enough")
        return self
