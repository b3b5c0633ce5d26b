"""The configuration of `visfuse track-stereo-pf`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from visfuse_cli.config import Section


class FilterSettings(Section):
    """The particle filter, and how vehicles move."""

    particles: int = Field(400, ge=20, le=100_000, description="how many poses are tried in each frame")
    path_constraint: bool = Field(True, description="true: the vehicle keeps to its path; false: it moves freely")
    kind: Literal["particles", "triangulation"] = Field(
        "particles",
        description="particles; or, for comparison, the triangulated middle of the patch and a Kalman filter",
    )
    sigma_v: float | None = Field(
        None, gt=0, le=50, description="m/s a frame at 5 frames/s: change of speed; empty: told by each track itself"
    )
    sigma_lateral: float = Field(0.10, gt=0, le=10, description="m a frame at 5 frames/s: drift across the path")
    sigma_vertical: float = Field(0.03, gt=0, le=10, description="m a frame at 5 frames/s: drift up and down")
    free_share: float = Field(0.2, gt=0, le=5, description="drift without a path, as a share of the way in a frame")
    start_speed: float = Field(20.0, gt=0, le=200, description="m/s: speeds tried where none is given")
    speed_share: float = Field(0.15, gt=0, le=1, description="how far a given speed may be off, as a share of it")


class ObservationSettings(Section):
    """How a pose is compared with the pictures."""

    parts: int = Field(10, ge=4, le=16, description="into how many parts the patch is divided (Zhu 2012: 10)")
    lambda_d: float = Field(15.0, gt=0, le=1000, description="weight of the parts' distance (Zhu 2012: 15)")
    lambda_c: float = Field(20.0, gt=0, le=1000, description="weight of the correlation across views (Zhu 2012: 20)")
    epsilon: float = Field(0.3, ge=0, lt=1, description="weight of the old reference at an update (Zhu 2012: 0.3)")
    first_share: float = Field(
        0.5, ge=0, le=1, description="weight that the first reference keeps, so that it cannot drift"
    )
    fresh: float = Field(
        0.9, gt=0, lt=1, description="correlation below which the patch is taken anew: it has turned since"
    )
    good: float = Field(0.6, gt=0, lt=1, description="correlation from which on a patch is recognised")


class DetectionSettings(Section):
    """How vehicles are found where no init.yaml names them."""

    smallest: int = Field(18, ge=8, le=1000, description="px: shortest side of a region that is looked at")
    confirm_frames: int = Field(2, ge=1, le=100, description="frames in a row in which a region must grow or move")
    threshold: float = Field(16.0, gt=0, le=1000, description="squared grey-level deviations that count as motion")
    warmup_s: float = Field(60.0, gt=0, le=3600, description="s of footage from which the empty scene is made")
    margin: float = Field(0.06, ge=0, lt=0.4, description="share of a region's sides that is left out of the patch")


class LifeSettings(Section):
    """When a track ends, and which tracks count."""

    max_coast_s: float = Field(0.8, ge=0, le=60, description="s without a recognised patch before a track ends")
    min_frames: int = Field(4, ge=2, le=1000, description="measured frames that a track needs")
    min_share: float = Field(0.5, ge=0, le=1, description="share of its frames in which a track must be measured")
    min_distance: float = Field(0.2, ge=0, le=1000, description="m that a vehicle found unaided must move")


class DisplaySettings(Section):
    """Annotation and screen only."""

    units: Literal["km/h", "mph", "m/s"] = Field("mph", description="unit of speed on the video and the screen")


class VideoSettings(Section):
    """Where times come from when the footage carries none."""

    fps: float | None = Field(None, gt=0, le=10000, description="frames/s of image folders without timestamps.csv")


class StereoConfig(Section):
    """Configuration of `visfuse track-stereo-pf`."""

    video: VideoSettings = VideoSettings()
    filter: FilterSettings = FilterSettings()
    observation: ObservationSettings = ObservationSettings()
    detection: DetectionSettings = DetectionSettings()
    life: LifeSettings = LifeSettings()
    display: DisplaySettings = DisplaySettings()
    smooth: bool = Field(True, description="true: a backward pass over each whole track; false: the causal filter")
    latency: float = Field(0.0, ge=0, le=10, description="s: every state is also predicted this far ahead")
