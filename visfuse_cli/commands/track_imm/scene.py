"""What both kinds of head read of their scene: views, sensors, targets, all of it checked before the first frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.files.scene import find_file
from visfuse_cli.files.sensors import Sensors
from visfuse_cli.files.stereo_scene import read_init
from visfuse_cli.files.video import VideoSource, open_source
from visfuse_cli.records import GivenTarget, Lens, RunRequest
from visfuse_cli.vision import patches

INIT = ("init.yaml", "init.yml")
BEYOND_S = 0.5  # s that footage may go on beyond the sensors
MIDDLE = (0.3, 0.7)  # of the picture, where a principal point lies


def check_kind(kind: str, known: Sequence[str], head: str) -> None:
    """Raises UsageError where a motion is asked for that this head has not."""
    if kind not in ("imm", *known):
        raise UsageError(f"filter.kind={kind} is no motion of a {head} head; it has imm, {', '.join(known)}")


def open_views(views: dict[str, Path], request: RunRequest) -> dict[str, VideoSource]:
    """The footage, view by view."""
    return {
        name: open_source(path, fps=request.config.video.fps, start=request.start, end=request.end, camera=name)
        for name, path in views.items()
    }


def check_size(calibration: Path, name: str, lens: Lens, size: tuple[int, int], stated: Sequence[int] | None) -> None:
    """Raises InputError where a calibration was made for footage of another size."""
    if stated is not None and tuple(stated) != size:
        raise InputError(f"{calibration}: is for {stated[0]}x{stated[1]}, but the footage is {size[0]}x{size[1]}")
    middle = lens.K[:2, 2] / np.array(size)
    if np.any(middle < MIDDLE[0]) or np.any(middle > MIDDLE[1]):
        raise InputError(
            f"{calibration}: {name} has its principal point at ({lens.K[0, 2]:.0f}, {lens.K[1, 2]:.0f}), "
            f"which is not near the middle of {size[0]}x{size[1]} footage; it was made for another size"
        )


def check_covered(path: Path, sensors: Sensors, t: float) -> None:
    """Raises InputError where the footage goes on beyond the sensors."""
    first, last = float(sensors.t[0]), float(sensors.t[-1])
    if t > last + BEYOND_S or t < first - BEYOND_S:
        raise InputError(
            f"{path}: samples run from t = {first:g} to {last:g} s, the footage has a frame at {t:.2f} s; "
            "times count from the first frame"
        )


def named_targets(folder: Path) -> tuple[Path | None, list[GivenTarget]]:
    """init.yaml, where the scene has one, and its targets."""
    path = find_file(folder, INIT)
    return path, [] if path is None else read_init(path)


def check_inside(init: Path | None, given: Sequence[GivenTarget], size: tuple[int, int]) -> None:
    """Raises InputError where a target, in straight pixels, lies outside of the picture."""
    for k, each in enumerate(given):
        if not patches.inside(each.left, size, -2.0):
            raise InputError(f"{init}, targets[{k}], left: lies outside of the {size[0]}x{size[1]} picture")
