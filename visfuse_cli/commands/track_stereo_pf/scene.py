"""A stereo scene: what its folder says, checked before the first frame, and its pairs of frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from visfuse_cli.errors import InputError
from visfuse_cli.files.scene import check_scene, file, find_file, view
from visfuse_cli.files.stereo_calibration import FILES, read_rig
from visfuse_cli.files.stereo_scene import GivenPath, read_init, read_path
from visfuse_cli.files.video import VideoSource, open_source
from visfuse_cli.maths import paths
from visfuse_cli.maths.paths import Way
from visfuse_cli.pipeline import Run
from visfuse_cli.records import FrameSet, GivenTarget, RunRequest, StereoRig
from visfuse_cli.vision import patches
from visfuse_cli.vision.lens import undistort_points

VIEWS = ("left", "right")
AGREE = 0.5  # of the rate's interval, within which two frames make a pair


@dataclass(slots=True)
class Scene:
    """All that a run needs to know of its scene."""

    rig: StereoRig
    views: dict[str, Path]
    files: list[Path]
    given: list[GivenTarget]
    way: Way | None
    size: tuple[int, int]


def read(request: RunRequest) -> Scene:
    """The scene, all of it checked."""
    folder = request.input
    check_scene(folder)
    calibration = file(folder, FILES, "calibration of the pair")
    rig = read_rig(calibration)
    views = {name: view(folder, name) for name in VIEWS}
    files, given, way = [calibration], [], None
    init, path = find_file(folder, ("init.yaml", "init.yml")), find_file(folder, ("path.yaml", "path.yml"))
    if init is not None:
        files.append(init)
        given = [_straight_target(each, rig) for each in read_init(init)]
    if path is not None:
        files.append(path)
        way = _way(path, read_path(path), rig)
    scene = Scene(rig, views, files, given, way, (0, 0))
    sizes = {}
    for name, source in open_views(scene, request).items():
        sizes[name] = (source.width, source.height)
    if sizes["left"] != sizes["right"]:
        left, right = ("x".join(map(str, sizes[name])) for name in VIEWS)
        raise InputError(f"{folder}: left is {left} and right is {right}; both views need one size")
    scene.size = sizes["left"]
    _check_size(calibration, rig, scene.size)
    for k, each in enumerate(given):
        _check_quads(f"{init}, targets[{k}]", each, scene.size)
    return scene


def _check_size(calibration: Path, rig: StereoRig, size: tuple[int, int]) -> None:
    if rig.image_size is not None and tuple(rig.image_size) != size:
        named = "x".join(str(int(n)) for n in rig.image_size)
        raise InputError(f"{calibration}: is for {named}, but the footage is {size[0]}x{size[1]}")
    for name, lens in (("M1", rig.left), ("M2", rig.right)):
        middle = lens.K[:2, 2] / np.array(size)
        if np.any(middle < 0.15) or np.any(middle > 0.85):
            raise InputError(
                f"{calibration}: {name} has its principal point at ({lens.K[0, 2]:.0f}, {lens.K[1, 2]:.0f}), which is "
                f"not near the middle of {size[0]}x{size[1]} footage; it was made for another size"
            )


def _check_quads(where: str, each: GivenTarget, size: tuple[int, int]) -> None:
    for name, quad in (("left", each.left), ("right", each.right)):
        if quad is not None and not patches.inside(quad, size, -0.5):
            raise InputError(f"{where}, {name}: lies outside of the {size[0]}x{size[1]} picture")


def _straight_target(each: GivenTarget, rig: StereoRig) -> GivenTarget:
    right = None if each.right is None else undistort_points(each.right, rig.right)
    return replace(each, left=undistort_points(each.left, rig.left), right=right)


def _way(path: Path, given: GivenPath, rig: StereoRig) -> Way:
    """The path in space; raises InputError where its images do not fit one."""
    try:
        if given.points is not None:
            return Way(given.points)
        assert given.left is not None
        assert given.right is not None
        left, right = undistort_points(given.left, rig.left), undistort_points(given.right, rig.right)
        return paths.straight(rig, left, right) if len(left) == 2 else paths.curved(rig, left, right)
    except ValueError as problem:
        raise InputError(f"{path}: {problem}") from problem


def open_views(scene: Scene, request: RunRequest) -> dict[str, VideoSource]:
    fps = request.config.video.fps
    return {
        name: open_source(path, fps=fps, start=request.start, end=request.end, camera=name)
        for name, path in scene.views.items()
    }


def pairs(sources: dict[str, VideoSource], run_: Run) -> Iterator[FrameSet]:
    """Pairs of frames near in time."""
    tolerance = AGREE / max(source.nominal_rate for source in sources.values())
    for pair in run_.synchronise(sources, tolerance):
        if not pair.missing:
            yield pair
