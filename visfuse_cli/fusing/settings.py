"""The configuration of `visfuse fuse-cameras`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator, model_validator

from visfuse_cli.config import Section
from visfuse_cli.tracking.lookout import BackgroundSettings


class PersonSettings(Section):
    """What is looked for."""

    height: float = Field(1.72, gt=0.3, le=3, description="m: usual height")
    height_sigma: float = Field(0.12, gt=0, le=1, description="m: how much people differ from it")
    width: float = Field(0.55, gt=0.1, le=2, description="m: usual width across, arms included")
    shortest: float = Field(1.0, gt=0.2, le=3, description="m: what is lower is no person")
    tallest: float = Field(2.3, gt=0.3, le=4, description="m: what is higher is no person")

    @model_validator(mode="after")
    def _ordered(self) -> PersonSettings:
        if not self.shortest < self.height < self.tallest:
            raise ValueError("shortest < height < tallest is needed")
        return self


class WorldSettings(Section):
    """Where people stand."""

    ground: tuple[float, float, float, float] = Field(
        (0.0, 0.0, 1.0, 0.0), description="[a, b, c, d]: a x + b y + c z + d = 0, positive on the cameras' side"
    )

    @field_validator("ground")
    @classmethod
    def _plane(cls, plane: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        if max(map(abs, plane)) > 1e9:
            raise ValueError("holds a number beyond 1e9")
        if not sum(n * n for n in plane[:3]) > 1e-12:
            raise ValueError("a, b and c are all zero: that is no plane")
        return plane


class SightSettings(Section):
    """How people are seen in one camera, and how well."""

    pixels: int = Field(
        400_000, ge=10_000, le=50_000_000, description="px: larger pictures are looked at in a smaller copy"
    )
    edge_px: float = Field(1.2, gt=0, le=50, description="px: noise of a box's side")
    edge_m: float = Field(0.06, ge=0, le=1, description="m: what swinging limbs and clothes add to it")
    box_share: float = Field(
        0.03, gt=0, le=1, description="noise of a side of an external box, as a share of the box's height"
    )
    gate: float = Field(0.999, gt=0.5, lt=1, description="probability inside the association gates")
    association: Literal["one-to-one", "jpda"] = Field(
        "one-to-one",
        description="of external boxes: one-to-one: each is of one person or nobody; jpda: each counts by how likely "
        "it is whose, for detectors that miss and invent many",
    )
    detected: float = Field(0.9, gt=0, lt=1, description="share of its people that a detector boxes (jpda)")
    false_boxes: float = Field(0.5, gt=0, le=1000, description="boxes of nobody in a picture, on the average (jpda)")


class FusionSettings(Section):
    """How the cameras' findings become one estimate."""

    method: Literal["closed-loop", "naive", "kim", "covariance-intersection", "central"] = Field(
        "closed-loop", description="closed-loop: pairs of cameras as local estimators, fed back; others: for comparison"
    )
    point: Literal["centroid", "foot"] = Field(
        "centroid", description="the person's point that is tracked; measured alike in all views"
    )
    offsets: dict[str, float] = Field(
        {}, description="s by camera: added to its own times to reach the clock that all share"
    )
    largest_offset: float = Field(3.0, gt=0, le=600, description="s: how far --estimate-offsets searches")

    @field_validator("offsets")
    @classmethod
    def _sane(cls, offsets: dict[str, float]) -> dict[str, float]:
        for name, seconds in offsets.items():
            if not abs(seconds) < 86400:
                raise ValueError(f"camera '{name}': {seconds} s is more than a day")
        return offsets


class FilterSettings(Section):
    """The motion of people: constant velocity, disturbed."""

    sigma_a: float = Field(0.8, gt=0, le=50, description="m/s^2 per root Hz: how hard people change pace and course")
    hold_s: float = Field(
        0.8, gt=0.01, le=10, description="s: how long a change of pace goes on; whole tracks are smoothed with it"
    )
    sigma_z: float = Field(0.03, gt=0, le=50, description="m/s^2 per root Hz: the same, up and down")
    start_speed: float = Field(1.0, gt=0, le=20, description="m/s: speed that may be there when a person is first seen")
    adapt: bool = Field(True, description="settle the noise of the whole track by what its own residuals say")


class LifeSettings(Section):
    """When a track starts, rests and ends."""

    confirm_s: float = Field(0.3, ge=0, le=60, description="s: a person must be seen this long by two cameras or more")
    confirm_frames: int = Field(3, ge=1, le=100, description="sets of frames it must be seen in")
    max_coast_s: float = Field(2.0, gt=0, le=60, description="s: prediction without measurement before a track ends")
    max_missed: int = Field(
        40, ge=1, le=100000, description="times that cameras with a clear sight of the place may not see somebody"
    )
    min_duration_s: float = Field(0.8, ge=0, le=600, description="s: a track that was measured for less is dropped")
    max_doubt: float = Field(
        0.3, gt=0, le=100, description="m: deviation beyond which no place is told of who is seen by one camera alone"
    )
    nearest: float = Field(0.25, gt=0, le=5, description="m: two people cannot stand nearer to each other")


class DisplaySettings(Section):
    """Annotation and screen only."""

    units: Literal["km/h", "mph", "m/s"] = Field("m/s", description="unit of speed on the video and the screen")


class VideoSettings(Section):
    """Where times come from when the footage carries none."""

    fps: float | None = Field(
        None, gt=0, le=10000, description="frames/s of image folders without timestamps.csv, and of boxes without video"
    )


class FuseConfig(Section):
    """Configuration of `visfuse fuse-cameras`."""

    video: VideoSettings = VideoSettings()
    world: WorldSettings = WorldSettings()
    background: BackgroundSettings = BackgroundSettings(warmup_s=60.0, memory_s=240.0)
    person: PersonSettings = PersonSettings()
    sight: SightSettings = SightSettings()
    fusion: FusionSettings = FusionSettings()
    filter: FilterSettings = FilterSettings()
    life: LifeSettings = LifeSettings()
    display: DisplaySettings = DisplaySettings()
    smooth: bool = Field(True, description="true: a backward pass over each whole track; false: causal output")
