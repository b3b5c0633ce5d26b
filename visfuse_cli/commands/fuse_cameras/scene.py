"""The scene folder of `visfuse fuse-cameras`: cameras, footage and clocks, all of it checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.multi_calibration import read_views
from visfuse_cli.files.multi_scene import Footage, find_footage
from visfuse_cli.files.scene import check_scene
from visfuse_cli.files.video import VideoSource
from visfuse_cli.fusing.settings import FuseConfig
from visfuse_cli.maths import multiview
from visfuse_cli.records import Array, RunRequest, TimeAudit, View


@dataclass(slots=True)
class Scene:
    """Everything a run needs to know of its scene; views are in the ground's frame, x_ground = R x_world + t."""

    views: list[View]
    footage: list[Footage]
    files: list[Path]
    R: Array
    t: Array
    P: Array

    @property
    def names(self) -> list[str]:
        return [view.name for view in self.views]


def read(request: RunRequest) -> Scene:
    """The scene's cameras and footage, all of it checked."""
    config: FuseConfig = request.config
    check_scene(request.input)
    views, files = read_views(request.input)
    R, t = multiview.ground_from_world(np.array(config.world.ground))
    moved = [multiview.moved_view(view, R, t) for view in views]
    low = [view for view in moved if view.centre[2] <= 0.05]
    if low:
        raise InputError(
            f"{files[0]}: camera '{low[0].name}' lies {-low[0].centre[2]:.2f} m below the ground; "
            "set world.ground [a, b, c, d] so that a x + b y + c z + d is positive where the cameras are"
        )
    footage = find_footage(request.input, moved, config.video.fps)
    scene = Scene(moved, footage, files, R, t, np.stack([multiview.projection(view) for view in moved]))
    for source in open_footage(scene, request).values():
        source.__exit__(None, None, None)
    return scene


def open_footage(scene: Scene, request: RunRequest) -> dict[str, VideoSource]:
    fps = request.config.video.fps
    return {each.view.name: each.open(fps, request.start, request.end) for each in scene.footage}


def given_offsets(config: FuseConfig, scene: Scene) -> dict[str, float]:
    """Seconds by camera, all of them; raises UsageError for a camera that is not there."""
    unknown = [name for name in config.fusion.offsets if name not in scene.names]
    if unknown:
        raise UsageError(f"fusion.offsets: no camera '{unknown[0]}'; the scene has {', '.join(scene.names)}")
    return {name: config.fusion.offsets.get(name, 0.0) for name in scene.names}


def tolerance(sources: dict[str, VideoSource]) -> float:
    """How far (s) a frame may be from the instant of its set: half of the longest interval, and a little."""
    return 0.55 * interval(sources)


def spacing(sources: dict[str, VideoSource]) -> float:
    """The time (s) from one set to the next where the first camera has nothing."""
    return 1 / next(iter(sources.values())).nominal_rate


def interval(sources: dict[str, VideoSource]) -> float:
    """The longest time (s) from one frame to the next."""
    return 1 / min(source.nominal_rate for source in sources.values())


def shorter(audits: dict[str, TimeAudit]) -> list[str]:
    """Which cameras' footage ends well before the longest."""
    longest = max(audit.duration_s for audit in audits.values())
    return [
        f"camera '{name}' ends after {audit.duration_s:.1f} s, {longest - audit.duration_s:.1f} s before the longest"
        for name, audit in audits.items()
        if longest - audit.duration_s > max(1.0, 0.02 * longest)
    ]
