"""The footage of several cameras: which file is whose, and whether it all fits the calibration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from visfuse_cli.errors import InputError
from visfuse_cli.files.box_times import BoxTimes
from visfuse_cli.files.detections import read_mot
from visfuse_cli.files.scene import find_view
from visfuse_cli.files.video import VideoSource, open_source
from visfuse_cli.records import Array, View


@dataclass(frozen=True, slots=True)
class Footage:
    """What one camera recorded: a video or image folder, boxes [x, y, w, h, score] by frame, or both."""

    view: View
    video: Path | None
    boxes: dict[int, Array] | None
    box_file: Path | None
    instants: int = 0  # of boxes without video

    @property
    def files(self) -> list[Path]:
        """The files it is in."""
        return [path for path in (self.video, self.box_file) if path is not None]

    def open(self, fps: float | None, start: float | None, end: float | None) -> VideoSource:
        """The camera's frames; raises InputError where they cannot be read or have another size than calibrated."""
        name = self.view.name
        if self.video is None:
            assert fps is not None
            times = BoxTimes(self.instants, fps, self.view.size)
            return VideoSource(Path(f"{name}.txt"), times, name, start, end)
        source = open_source(self.video, fps=fps, start=start, end=end, camera=name)
        if (source.width, source.height) != self.view.size:
            wide, high = self.view.size
            raise InputError(
                f"{self.video}: is {source.width}x{source.height}, but camera '{name}' was calibrated for "
                f"{wide}x{high}; give the footage as it was calibrated"
            )
        return source


def find_footage(scene: Path, views: list[View], fps: float | None) -> list[Footage]:
    """The footage of every camera; raises InputError where one has none, or they do not go together."""
    found = []
    for view in views:
        video, text = find_view(scene, view.name), scene / f"{view.name}.txt"
        boxes = read_mot(text) if text.exists() else None
        if video is None and boxes is None:
            raise InputError(
                f"{scene}: camera '{view.name}' of the calibration has no footage: neither a video {view.name}.* "
                f"nor an image folder {view.name}/ nor boxes {view.name}.txt"
            )
        found.append(Footage(view, video, boxes, text if boxes is not None else None))
    without = [each.view.name for each in found if each.boxes is None]
    if without and len(without) < len(found):
        raise InputError(
            f"{scene}: camera '{without[0]}' has no boxes {without[0]}.txt, while others have; "
            "give boxes for every camera or for none"
        )
    blind = [each for each in found if each.video is None]
    if blind and fps is None:
        raise InputError(f"{blind[0].box_file}: boxes carry no times; set video.fps to the rate of their frames")
    count = max((max(each.boxes, default=-1) + 1 for each in found if each.boxes is not None), default=0)
    if blind and not count:
        raise InputError(f"{scene}: the cameras' box files hold no box at all")
    return [Footage(each.view, each.video, each.boxes, each.box_file, count) for each in found]
