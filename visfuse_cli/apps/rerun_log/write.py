"""A run as a Rerun recording."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from visfuse_cli.apps.rerun_log.scenes import Eye, Scene
from visfuse_cli.files.atomic import replacing_path
from visfuse_cli.records import Array
from visfuse_cli.vision.drawing import colour_of

QUALITY = 80  # of JPEG
SHARE = 0.95  # of the probability inside an ellipsoid
FLAT = 0.02  # m: thickness of an ellipsoid on the ground
GREY = (130, 130, 130)


def record(scene: Scene, run: Path, path: Path) -> None:
    """Write the recording of a run folder; raises OutputError where it cannot be written."""
    document = json.loads((run / "tracks.json").read_text(encoding="utf-8"))
    with replacing_path(path) as partial, rr.RecordingStream(f"visfuse {document['command']}") as stream:
        stream.save(partial)
        axes = rr.ViewCoordinates.RIGHT_HAND_Z_UP if scene.z_up else rr.ViewCoordinates.RDF
        stream.log("world", axes, static=True)
        for track in document["tracks"]:
            _track(stream, track, scene.height)
        boxes = _boxes(document["tracks"])
        for eye in scene.eyes:
            _eye(stream, eye, boxes)
        stream.flush()
        stream.disconnect()


def _colour(track: int) -> tuple[int, int, int]:
    """RGB of a track in its video."""
    blue, green, red = colour_of(track)
    return red, green, blue


def _at(stream: rr.RecordingStream, frame: int, t: float) -> None:
    stream.set_time("t", duration=t)
    stream.set_time("frame", sequence=frame)


def _eye(stream: rr.RecordingStream, eye: Eye, boxes: dict[tuple[str, str], dict[int, list[tuple[int, Any]]]]) -> None:
    """A camera, its frames, and the boxes on them; boxes without footage are left out."""
    place = f"world/cameras/{eye.name}"
    if eye.K is not None:
        pinhole = rr.Pinhole(image_from_camera=eye.K, resolution=eye.size, camera_xyz=rr.ViewCoordinates.RDF)
        stream.log(place, pinhole, static=True)
        if eye.footage is None:
            _place(stream, eye, place, 0, static=True)
    on_frame = boxes.get((eye.view, eye.clip), {})
    for frame, image in eye.frames():
        _at(stream, frame.index, frame.t)
        _place(stream, eye, place, frame.index)
        encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
        stream.log(f"{place}/picture", rr.EncodedImage(contents=encoded, media_type="image/jpeg"))
        found = on_frame.get(frame.index, [])
        shown = rr.Boxes2D(
            array=np.array([box for _, box in found], dtype=float).reshape(-1, 4),
            array_format=rr.Box2DFormat.XYWH,
            labels=[str(track) for track, _ in found],
            colors=[_colour(track) for track, _ in found],
        )
        stream.log(f"{place}/boxes", shown)


def _place(stream: rr.RecordingStream, eye: Eye, place: str, frame: int, static: bool = False) -> None:
    pose = eye.pose(frame)
    if pose is not None:
        stream.log(place, rr.Transform3D(mat3x3=pose[0], translation=pose[1]), static=static)


def _boxes(tracks: list[dict[str, Any]]) -> dict[tuple[str, str], dict[int, list[tuple[int, Any]]]]:
    """By view and clip, by frame: the tracks' boxes [x, y, w, h] px."""
    found: dict[tuple[str, str], dict[int, list[tuple[int, Any]]]] = defaultdict(lambda: defaultdict(list))
    for track in tracks:
        for state in track["states"]:
            for view, box in state.get("box", {}).items():
                found[view, track.get("clip", "")][state["frame"]].append((track["id"], box))
    return found


def _track(stream: rr.RecordingStream, track: dict[str, Any], height: float) -> None:
    """The way of a track, and where it is at each instant with its covariance, speed and models."""
    states, number = track["states"], track["id"]
    colour = GREY if track["summary"].get("rejected") else _colour(number)
    points = _in_space(np.array([state["position"] for state in states], dtype=float), height)
    size = len(states[0]["position"])
    cov = np.array([np.array(state["covariance"])[:size, :size] for state in states])
    half, quaternions = _ellipsoids(cov)
    place = f"world/tracks/{number}"
    stream.log(f"{place}/way", rr.LineStrips3D([points], colors=[colour]), static=True)
    for k, state in enumerate(states):
        _at(stream, state["frame"], state["t"])
        name = f"{number}" if state.get("measured", True) else f"{number} (predicted)"
        stream.log(f"{place}/point", rr.Points3D(points[k : k + 1], colors=[colour], labels=[name], radii=[0.06]))
        shape = rr.Ellipsoids3D(
            centers=points[k : k + 1], half_sizes=half[k : k + 1], quaternions=quaternions[k : k + 1], colors=[colour]
        )
        stream.log(f"{place}/covariance", shape)
        stream.log(f"speed/{number}", rr.Scalars(state["speed"]))
        for model, share in state.get("models", {}).items():
            stream.log(f"models/{number}/{model}", rr.Scalars(share))
    last = states[-1]
    step = (last["t"] - states[0]["t"]) / max(len(states) - 1, 1)
    _at(stream, last["frame"] + 1, last["t"] + step)
    for part in ("point", "covariance"):
        stream.log(f"{place}/{part}", rr.Clear(recursive=True))


def _in_space(points: Array, height: float) -> Array:
    """Points (n, 2 or 3) m as (n, 3)."""
    return points if points.shape[1] == 3 else np.column_stack([points, np.full(len(points), height)])


def _ellipsoids(cov: Array) -> tuple[Array, Array]:
    """Half axes (n, 3) m and orientations (n, 4) as quaternions xyzw of covariances (n, 2, 2) or (n, 3, 3)."""
    size = cov.shape[1]
    whole = np.tile(np.diag([0.0, 0.0, (FLAT / 2) ** 2 / chi2.ppf(SHARE, size)]), (len(cov), 1, 1))
    whole[:, :size, :size] = cov
    values, axes = np.linalg.eigh(whole)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    half = np.sqrt(np.maximum(values, 0) * chi2.ppf(SHARE, size))
    return half, np.asarray(Rotation.from_matrix(axes).as_quat())
