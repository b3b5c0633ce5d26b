"""The tracker's part of the configuration, shared by every command that follows things on the ground."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator, model_validator

from visfuse_cli.config import Section
from visfuse_cli.maths.polygons import Polygon, surrounding


class SizePrior(Section):
    """What a class of road user measures: means and deviations in metres."""

    name: str = Field(min_length=1, description="class written to tracks.json")
    length: tuple[float, float] = Field(description="m: mean and standard deviation")
    width: tuple[float, float] = Field(description="m: mean and standard deviation")
    height: tuple[float, float] = Field(description="m: mean and standard deviation")

    @model_validator(mode="after")
    def _positive(self) -> SizePrior:
        for name in ("length", "width", "height"):
            mean, sigma = getattr(self, name)
            if not (0 < mean < 40 and 0 < sigma < 20):
                raise ValueError(f"{name} needs a mean in (0, 40) m and a deviation in (0, 20) m")
        return self


VEHICLES = (
    SizePrior(name="car", length=(4.2, 0.7), width=(1.8, 0.15), height=(1.5, 0.15)),
    SizePrior(name="van", length=(5.2, 0.8), width=(2.0, 0.15), height=(2.2, 0.3)),
    SizePrior(name="truck", length=(9.5, 2.2), width=(2.5, 0.2), height=(3.3, 0.5)),
    SizePrior(name="two-wheeler", length=(2.0, 0.25), width=(0.75, 0.15), height=(1.6, 0.2)),
)
PERSON = (SizePrior(name="person", length=(0.5, 0.12), width=(0.5, 0.12), height=(1.72, 0.12)),)


class TargetSettings(Section):
    """What is looked for."""

    motion: Literal["bicycle", "constant-velocity"] = Field(
        "bicycle", description="bicycle: vehicles that steer; constant-velocity: people"
    )
    classes: tuple[SizePrior, ...] = Field(
        VEHICLES, min_length=1, description="size priors; each track takes the class that explains its outline best"
    )
    smallest: float = Field(0.5, gt=0, le=10, description="m: regions smaller than this in both directions are ignored")
    height: float = Field(
        0.0, ge=-100, le=1000, description="m: how far above the surveyed plane the plane lies that targets stand on"
    )


class PoseSettings(Section):
    """How well a box sits on a region."""

    sigma_px: float = Field(1.5, gt=0, le=50, description="px: noise of a region's tangent")
    sigma_share: float = Field(
        0.02, ge=0, le=1, description="noise of a tangent that grows with the outline, as a share of its width"
    )
    bias_px: float = Field(
        1.0, ge=0, le=20, description="px: outline error that stays over a vehicle's life; widens the speed interval"
    )
    border_px: float = Field(
        0.5, ge=-5, le=5, description="px: how far a vehicle's true outline lies outside its region's pixel centres"
    )
    gate: float = Field(0.999, gt=0.5, lt=1, description="probability inside the association gate")


class FilterSettings(Section):
    """The motion filter."""

    kind: Literal["fading", "ekf", "cuf", "fading-cuf", "imm"] = Field(
        "fading",
        description="ekf: extended Kalman filter; fading: the same with a fading factor, prompt in manoeuvres; "
        "cuf: with the acceleration in the state; fading-cuf: both; imm: three motions by speed and course, which "
        "sees furthest ahead",
    )
    sigma_a: float = Field(0.8, gt=0, le=50, description="m/s^2 per root Hz: how hard the target accelerates")
    sigma_steer: float = Field(
        0.15, gt=0, le=5, description="rad/s per root Hz: how fast the steering angle changes at walking pace (not imm)"
    )
    sigma_corner: float = Field(
        6.0,
        gt=0,
        le=1000,
        description="m/s^3 per root Hz: how fast the lateral acceleration changes, at speed (not imm)",
    )
    straighten: float = Field(
        2.0, ge=0, le=100, description="1/s: how fast drivers let the steering go back to straight; 0: never"
    )
    sigma_jerk: float = Field(
        0.7, gt=0, le=100, description="m/s^3 per root Hz: how fast the acceleration changes (cuf, imm)"
    )
    sigma_turn: float = Field(
        0.2, gt=0, le=20, description="rad/s^2 per root Hz: how fast the rate of turn changes (imm)"
    )
    stay: float = Field(0.97, gt=0.5, lt=1, description="probability that a motion goes on over one frame (imm)")
    adapt_noise: bool = Field(
        True, description="scale the measurement noise by what the innovations of the whole track say"
    )


class LifeSettings(Section):
    """When a track starts, rests and ends."""

    confirm_m: float = Field(1.5, gt=0, le=50, description="m: way on the ground that makes a region a track")
    confirm_frames: int = Field(4, ge=3, le=100, description="frames seen before a region can become a track")
    tentative_s: float = Field(6.0, gt=0, le=600, description="s: how long a region may stand before it is given up")
    max_coast_s: float = Field(1.2, gt=0, le=60, description="s: prediction without measurement before a track ends")
    max_refused_s: float = Field(
        0.4, gt=0, le=60, description="s: measurements outside the gate in a row before a track ends"
    )
    look_back_s: float = Field(4.0, ge=0, le=30, description="s: how far back a new track is followed to its beginning")
    birth_scale: float = Field(0.45, gt=0, le=20, description="m of ground a pixel: further away no track starts")
    max_scale: float = Field(1.0, gt=0, le=20, description="m of ground a pixel: further away nothing is tracked")


class TrackerSettings(Section):
    """Everything the ground-plane tracker can be told."""

    target: TargetSettings = TargetSettings()
    pose: PoseSettings = PoseSettings()
    filter: FilterSettings = FilterSettings()
    life: LifeSettings = LifeSettings()
    smooth: bool = Field(True, description="true: a backward pass over each whole track; false: causal output")
    latency: float = Field(0.0, ge=0, le=10, description="s: every state is also predicted this far ahead")
    region: Polygon = Field((), description="polygon of ground points [X, Y] m outside of which nothing is tracked")

    @field_validator("region")
    @classmethod
    def _surrounds(cls, region: Polygon) -> Polygon:
        return region and surrounding(region, "the polygon")
