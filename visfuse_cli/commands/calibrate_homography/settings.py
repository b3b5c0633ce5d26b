"""The configuration of `visfuse calibrate-homography`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from visfuse_cli.config import Section


class NoiseSettings(Section):
    """How well points were picked; used where there are too few to tell from the residuals."""

    sigma_px: float = Field(1.0, gt=0, le=100, description="px: noise of an image point")
    sigma_rad: float = Field(0.001, gt=0, le=0.5, description="rad: noise of a gaze angle")


class RobustSettings(Section):
    """Leaving out what does not fit."""

    enabled: bool = Field(False, description="drop points that disagree with the rest")
    threshold_px: float = Field(5.0, gt=0, le=1000, description="px: further off than this is dropped")
    threshold_rad: float = Field(0.01, gt=0, le=1, description="rad: the same for gaze angles")


class SnapSettings(Section):
    """Moving roughly drawn lines onto the edges under them; needs --image."""

    enabled: bool = Field(False, description="move lines onto edges of the picture")
    radius_px: float = Field(8.0, gt=0, le=200, description="px: how far a line may move")


class GazeSettings(Section):
    """The pan-tilt head."""

    order: Literal["elevation-vergence", "vergence-elevation"] = Field(
        "elevation-vergence", description="outer axis first"
    )


class LimitSettings(Section):
    """When to warn and when to refuse."""

    condition: float = Field(1e5, gt=1, le=1e15, description="condition number above which the input is refused")
    leave_one_out_m: float = Field(
        1.0, gt=0, le=1e6, description="m: a point that moves further when left out is named"
    )


class CalibrateConfig(Section):
    """Configuration of `visfuse calibrate-homography`."""

    noise: NoiseSettings = NoiseSettings()
    robust: RobustSettings = RobustSettings()
    snap: SnapSettings = SnapSettings()
    gaze: GazeSettings = GazeSettings()
    limits: LimitSettings = LimitSettings()
