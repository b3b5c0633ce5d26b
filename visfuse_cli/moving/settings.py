"""The configuration of `visfuse track-imm`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from visfuse_cli.config import Section

MODELS = ("drifting", "cv", "ca", "periodic")


class OdometrySettings(Section):
    """The vehicle under the camera."""

    k_t: float = Field(1.0, description="m/s per volt of the tachometers")
    wheel_separation: float = Field(0.5, gt=0, le=20, description="m between the wheels")
    camera_yaw: float = Field(0.0, ge=-7, le=7, description="rad to the left of the driving direction")
    camera_offset: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="[right, down, forward] m of the left camera from the wheel axle's middle"
    )
    noise_share: float = Field(0.01, ge=0, le=1, description="deviation of a wheel's speed, as a share of it")
    noise: float = Field(0.002, ge=0, le=10, description="m/s: and apart from that")


class FlowSettings(Section):
    """Optical flow, for what moves by itself."""

    method: Literal["auto", "horn-schunck", "dis"] = Field(
        "auto", description="auto: Horn-Schunck for pictures of up to 480 lines, else DIS"
    )
    smoothness: float = Field(8.0, gt=0, le=1000, description="Horn-Schunck: weight of smooth flow, grey levels")
    iterations: int = Field(40, ge=1, le=1000, description="Horn-Schunck: rounds a level")
    sigma: float = Field(1.0, ge=0, le=20, description="px: Gaussian that smooths the pictures first")


class SegmentationSettings(Section):
    """K-means over flow, place and colour."""

    clusters: int | None = Field(None, ge=1, le=20, description="how many; empty: by the ratio of spreads")
    most: int = Field(6, ge=2, le=20, description="most clusters that are tried")
    smallest: float = Field(0.004, gt=0, lt=1, description="share of the picture below which a region is none")
    residual_px: float = Field(0.8, gt=0, le=50, description="px a frame of flow that the camera's motion leaves over")


class FilterSettings(Section):
    """The motion models and how they take turns."""

    kind: Literal["imm", "drifting", "cv", "ca", "periodic", "csd", "cs", "cd"] = Field(
        "imm", description="all of them, or one alone; csd, cs and cd are those of a pan-tilt head"
    )
    sojourn: float = Field(4.0, gt=0, le=1000, description="s that a motion goes on, on the average")
    q_drifting: float = Field(0.2, gt=0, description="m^2/s of a drifting point's walk")
    q_cv: float = Field(0.02, gt=0, description="m^2 s^-3 of constant velocity: for straight ways")
    q_ca: float = Field(1.0, gt=0, description="m^2 s^-5 of constant acceleration")
    q_periodic: float = Field(0.05, gt=0, description="m^2 s^-3 of the periodic motion")
    omega: float = Field(1.0, gt=0, le=50, description="rad/s of the periodic motion")
    euler: bool = Field(False, description="the periodic motion by the paper's growing forward step")
    sigma_speed: float = Field(
        0.2, gt=0, description="m/s^2 per root Hz: what changes a constant speed (pan-tilt head)"
    )
    sigma_course: float = Field(0.05, gt=0, description="rad/s per root Hz: what changes a constant direction")
    sigma_turn: float = Field(0.8, gt=0, description="rad/s^2 per root Hz: what changes the rate of turn")
    sigma_pull: float = Field(1.0, gt=0, description="m/s^3 per root Hz: what changes the acceleration")
    start_speed: float = Field(1.5, gt=0, le=100, description="m/s: deviation of the velocity at the start")


class MeasureSettings(Section):
    """How a target is measured."""

    good: float = Field(0.6, gt=0, lt=1, description="correlation from which on a target is recognised")
    fresh: float = Field(0.85, gt=0, lt=1, description="correlation below which its template is taken anew")
    flow_sigma: float = Field(0.15, gt=0, le=50, description="px: noise of the mean flow over the target")
    place_sigma: float = Field(0.15, gt=0, le=50, description="px: noise of the middle of the target's picture")
    disparity_sigma: float = Field(
        0.06, gt=0, le=10, description="px: noise of the disparity beyond the matching's own"
    )


class LifeSettings(Section):
    """When a track starts and ends, and which tracks count."""

    confirm_frames: int = Field(3, ge=1, le=100, description="frames in a row in which a region must move by itself")
    max_coast_s: float = Field(1.5, ge=0, le=60, description="s of prediction before a track ends")
    memory_s: float = Field(10.0, ge=0, le=600, description="s for which who left or was lost is known again")
    min_frames: int = Field(6, ge=2, le=1000, description="measured frames that a track needs")
    min_moved: float = Field(0.4, ge=0, le=1000, description="m that a target found unaided must move in the world")


class GazeSettings(Section):
    """A pan-tilt head."""

    order: Literal["elevation-vergence", "vergence-elevation"] = Field(
        "elevation-vergence", description="which axis is outside: the first one carries the other"
    )


class TargetSettings(Section):
    """What is tracked, before a pan-tilt head."""

    height: float | None = Field(
        None,
        ge=0,
        le=100,
        description="m: height over the ground of the box's middle; empty: its lower edge stands on it",
    )


class DisplaySettings(Section):
    """Annotation and screen only."""

    units: Literal["km/h", "mph", "m/s"] = Field("m/s", description="unit of speed on the video and the screen")


class VideoSettings(Section):
    """Where times come from when the footage carries none."""

    fps: float | None = Field(None, gt=0, le=10000, description="frames/s of image folders without timestamps.csv")


class ImmConfig(Section):
    """Configuration of `visfuse track-imm`."""

    video: VideoSettings = VideoSettings()
    odometry: OdometrySettings = OdometrySettings()
    flow: FlowSettings = FlowSettings()
    segmentation: SegmentationSettings = SegmentationSettings()
    filter: FilterSettings = FilterSettings()
    measure: MeasureSettings = MeasureSettings()
    life: LifeSettings = LifeSettings()
    gaze: GazeSettings = GazeSettings()
    target: TargetSettings = TargetSettings()
    display: DisplaySettings = DisplaySettings()
    latency: float = Field(0.0, ge=0, le=10, description="s: every state is also predicted this far ahead")
    smooth: bool = Field(True, description="true: a backward pass over each whole track; false: causal output")
