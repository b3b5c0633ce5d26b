"""The cameras of a run and where they stand, command by command."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from scipy.linalg import rq

from visfuse_cli.files import homography
from visfuse_cli.files.multi_calibration import read_views
from visfuse_cli.files.multi_scene import Footage, find_footage
from visfuse_cli.files.scene import file, find_view
from visfuse_cli.files.stereo_calibration import FILES, read_rig
from visfuse_cli.files.video import VideoSource, is_clip_folder, list_clips, open_source
from visfuse_cli.maths.cameras import ground_camera
from visfuse_cli.records import Array, Frame, GroundMap, Image, Lens, RunRequest

Poses = Callable[[int], tuple[Array, Array] | None]  # frame -> R (3, 3), T (3,): x_world = R x_camera + T


@dataclass(frozen=True, slots=True)
class Eye:
    """One camera: its name in the viewer, its view and clip in tracks.json, K (3, 3) px, and its poses."""

    name: str
    view: str
    clip: str
    K: Array | None
    size: tuple[int, int]
    pose: Poses
    footage: Callable[[], VideoSource] | None
    lens: Lens | None = None  # of pictures that the command looked at without their distortion

    def frames(self) -> Iterator[tuple[Frame, Image]]:
        """The frames, and the pictures as the command looked at them."""
        if self.footage is None:
            return
        with self.footage() as source:
            for frame in source.frames():
                image = frame.image
                if self.lens is not None and np.any(self.lens.D):
                    image = np.asarray(cv2.undistort(image, self.lens.K, self.lens.D), np.uint8)
                yield frame, image


@dataclass(frozen=True, slots=True)
class Scene:
    """The cameras, whether z is up (else y is down), and how high (m) 2D positions lie above z = 0."""

    eyes: list[Eye]
    z_up: bool
    height: float = 0.0


def scene_of(request: RunRequest, run: Path) -> Scene:
    """The cameras of a run's request; raises InputError where its files have changed meanwhile."""
    if request.command == "speed":
        return _before_one_camera(request)
    if request.command == "fuse-cameras":
        return _around(request)
    return _stereo(request, run)


def _before_one_camera(request: RunRequest) -> Scene:
    ground = homography.read(request.options["homography"])
    clips = list_clips(request.input) if is_clip_folder(request.input) else [request.input]
    several = len(clips) > 1
    eyes = []
    for clip in clips:
        footage = partial(open_source, clip, fps=request.config.video.fps, start=request.start, end=request.end)
        source = footage()
        size = (source.width, source.height)
        K, pose = _over_ground(ground, size)
        eyes.append(Eye(clip.stem if several else "image", "image", clip.name, K, size, pose, footage))
    return Scene(eyes, z_up=True, height=request.config.target.height)


def _over_ground(ground: GroundMap, size: tuple[int, int]) -> tuple[Array | None, Poses]:
    """K and pose of the camera behind a ground map; none where the ground's axes are left-handed."""
    camera = ground_camera(ground, size)
    K, R = rq(camera.image_from_world[:, :3])
    signs = np.diag(np.sign(np.diag(K)))
    K, R = K @ signs, signs @ R
    if np.linalg.det(R) < 0:
        return None, _nowhere
    return K / K[2, 2], _fixed(np.asarray(R.T, dtype=float), camera.centre)


def _around(request: RunRequest) -> Scene:
    views, _ = read_views(request.input)
    config = request.config
    eyes = []
    for each in find_footage(request.input, views, config.video.fps):
        view, open_ = each.view, partial(_opened, each, config.video.fps, request.start, request.end)
        pose = _fixed(view.R.T, view.centre)
        footage = open_ if each.video is not None else None
        eyes.append(Eye(view.name, view.name, "", view.lens.K, view.size, pose, footage))
    return Scene(eyes, z_up=True)


def _opened(footage: Footage, fps: float | None, start: float | None, end: float | None) -> VideoSource:
    return footage.open(fps, start, end)


def _stereo(request: RunRequest, run: Path) -> Scene:
    document = json.loads((run / "run.json").read_text(encoding="utf-8"))
    on_ground = "head" in document  # a pan-tilt head: it turns, and one view is all there is
    names = ("left",) if on_ground else ("left", "right")
    rig = None if on_ground else read_rig(file(request.input, FILES, "calibration of the pair"))
    head = _driven(document["ego"]) if "ego" in document else _fixed(np.eye(3), np.zeros(3))
    eyes = []
    for name in names:
        path = find_view(request.input, name)
        assert path is not None  # the command has just read it
        footage = partial(open_source, path, fps=request.config.video.fps, start=request.start, end=request.end)
        source = footage()
        lens = None if rig is None else getattr(rig, name)
        pose = _nowhere if rig is None else head if name == "left" else _beside(head, rig.R, rig.T)
        K, size = None if lens is None else lens.K, (source.width, source.height)
        straight = lens if request.command == "track-imm" else None
        eyes.append(Eye(name, name, "", K, size, pose, footage, straight))
    return Scene(eyes, z_up=on_ground, height=request.config.target.height or 0.0 if on_ground else 0.0)


def _nowhere(frame: int) -> None:
    """A camera whose place is not known."""


def _fixed(R: Array, T: Array) -> Poses:
    return lambda frame: (R, T)


def _driven(ego: dict[str, list[object]]) -> Poses:
    """Where run.json says that the left camera was, frame by frame."""
    places = {
        frame: (np.array(R, dtype=float), np.array(T, dtype=float))
        for frame, R, T in zip(ego["frame"], ego["rotation"], ego["position"], strict=True)
    }
    return places.get


def _beside(left: Poses, R: Array, T: Array) -> Poses:
    """The right camera, x_right = R x_left + T."""

    def pose(frame: int) -> tuple[Array, Array] | None:
        head = left(frame)
        return None if head is None else (head[0] @ R.T, head[1] - head[0] @ R.T @ T)

    return pose
