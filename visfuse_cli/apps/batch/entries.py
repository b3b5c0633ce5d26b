"""What a manifest may say: the file as a whole, and an item of each command."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, model_validator

from visfuse_cli.config import Section

NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,99}$"


class Manifest(Section):
    """A manifest: what all items share, and the items, still unread."""

    retries: int = Field(0, ge=0, le=10, description="how often an item is tried again that failed by a defect or lock")
    defaults: dict[str, Any] = Field(default_factory=dict, description="keys of every item whose command knows them")
    items: tuple[dict[str, Any], ...] = Field(min_length=1, description="what to run")


class Entry(Section):
    """What an item of every command may say; paths are relative to the manifest, {stem} and {parent} the input's."""

    name: str | None = Field(None, pattern=NAME, description="folder of the results; of a glob, what it begins with")
    config: str | None = Field(None, description="a YAML file, or the name of a shipped configuration")
    set: dict[str, Any] = Field(default_factory=dict, description="a.b.c: VALUE, overrides of the configuration")


class TrackingEntry(Entry):
    """What an item of every tracking command may say."""

    input: str
    video: bool = True
    report: bool = True
    start: float | None = Field(None, ge=0, description="s of the footage")
    end: float | None = Field(None, gt=0, description="s of the footage")
    seed: int = Field(0, ge=0)

    @model_validator(mode="after")
    def _window(self) -> Self:
        if self.start is not None and self.end is not None and self.start >= self.end:
            raise ValueError(f"start {self.start:g} is not before end {self.end:g}")
        return self


class SpeedEntry(TrackingEntry):
    """`visfuse speed`."""

    homography: str
    detections: str | None = None
    log: str | None = None


class ImmEntry(TrackingEntry):
    """`visfuse track-imm`."""

    homography: str | None = None


class FuseEntry(TrackingEntry):
    """`visfuse fuse-cameras`."""

    estimate_offsets: bool = False


class CalibrateEntry(Entry):
    """`visfuse calibrate-homography`; one of the three tables is the item's input."""

    points: str | None = None
    lines: str | None = None
    gaze: str | None = None
    image: str | None = None
    size: str | None = Field(None, pattern=r"^[1-9][0-9]{0,5}[xX][1-9][0-9]{0,5}$", description="WxH")
    camera: str | None = None
    crs: str | None = None
    origin: str | None = None


ENTRIES: dict[str, type[Entry]] = {
    "speed": SpeedEntry,
    "track-imm": ImmEntry,
    "track-stereo-pf": TrackingEntry,
    "fuse-cameras": FuseEntry,
    "calibrate-homography": CalibrateEntry,
}
INPUTS = {"calibrate-homography": ("points", "lines", "gaze")}  # elsewhere: input
PATHS = ("homography", "detections", "image", "camera")  # must be there before anything runs
