"""A scene's files: clip.mp4, points.csv, truth.csv, drives.csv, vehicles.csv."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from samples.render import frames
from samples.road import calibration_points
from samples.scene import Array, Scene
from samples.visibility import truth_rows

STATES = "frame,t,id,x,y,z,vx,vy,vz"


def write_scene(scene: Scene, out: Path, *, noise_px: float = 0.4, crf: int = 23, n_points: int = 10) -> None:
    """Write the scene's files to the folder `out`; the same scene gives the same bytes.

    truth.csv has the vehicles where they can be seen, drives.csv all of them all the time, with their headings (rad).
    """
    out.mkdir(parents=True, exist_ok=True)
    points = calibration_points(scene, n_points, noise_px)
    _table(out / "points.csv", "u,v,X,Y", (f"{u:.3f},{v:.3f},{x:.4f},{y:.4f}" for u, v, x, y in points))
    _states(out / "truth.csv", truth_rows(scene))
    write_drives(scene, out / "drives.csv")
    _table(
        out / "vehicles.csv",
        "id,class,length,width,height",
        (f"{v.id},{v.kind},{v.length:.2f},{v.width:.2f},{v.height:.2f}" for v in scene.vehicles),
    )
    write_clip(out / "clip.mp4", frames(scene), scene.camera.size, scene.fps, crf)


def write_drives(scene: Scene, path: Path) -> None:
    """Write where every vehicle is all the time, and which way it faces."""
    rows = all_rows(scene)
    _table(path, f"{STATES},heading", (f"{line},{row[3][2]:.5f}" for row, line in zip(rows, _lines(rows), strict=True)))


def all_rows(scene: Scene) -> list[tuple[int, float, int, Array]]:
    """(frame, t, id, state (5,)) of every vehicle in every frame."""
    states = {vehicle.id: vehicle.trajectory(scene.times) for vehicle in scene.vehicles}
    return [(k, float(t), number, states[number][k]) for k, t in enumerate(scene.times) for number in sorted(states)]


def write_clip(
    path: Path, pictures: Iterable[NDArray[np.uint8]], size: tuple[int, int], fps: Fraction, crf: int
) -> None:
    """H.264 in MP4; frame i is stamped i / fps exactly."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.time_base = 1 / fps
        # one thread: the bytes must not depend on the machine's cores
        stream.codec_context.thread_count = 1
        stream.options = {"crf": str(crf), "preset": "veryfast"}
        for index, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24").reformat(format="yuv420p")
            frame.pts, frame.time_base = index, 1 / fps
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _states(path: Path, rows: list[tuple[int, float, int, Array]]) -> None:
    _table(path, STATES, _lines(rows))


def _lines(rows: list[tuple[int, float, int, Array]]) -> Iterator[str]:
    return (f"{frame},{t:.9f},{number},{s[0]:.4f},{s[1]:.4f},,{s[3]:.4f},{s[4]:.4f}," for frame, t, number, s in rows)


def _table(path: Path, header: str, rows: Iterable[str]) -> None:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
