"""What a detector of people would say of a yard: boxes that miss some, see nobody behind others, and invent some."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from samples.people import Yard, crossing
from samples.scene import Array, Camera
from samples.yard import write_calibration
from visfuse_cli.maths import multiview, people

HIDDEN = 0.6
"""Share of a box behind a nearer one from which on the detector sees one box."""
WIDTH_M = 0.55
REACH_M = 4.0
"""Metres from the yard's middle up to which somebody is invented."""


def passing(seed: int) -> Yard:
    """Two people who go the same way for eight seconds, one half a metre ahead, and change sides again and again."""
    yard = crossing(seed, seconds=8.0, people=2, cameras=3)
    times, along = np.linspace(0, 8, 6), np.linspace(-2, 2, 6)
    sides = [np.array([(-1) ** (k + j // 2) for j in range(6)]) for k in range(2)]
    walkers = [
        replace(walker, times=times, knots=np.column_stack([along + ahead, 0.35 * side]))
        for walker, side, ahead in zip(yard.walkers, sides, (-0.25, 0.25), strict=True)
    ]
    return replace(yard, walkers=tuple(walkers))


def write_boxes(
    yard: Yard, scene: Path, fps: float, missed: float = 0.1, false: float = 0.5, side: float = 0.02
) -> None:
    """Write calibration.toml, <camera>.txt and truth.csv of the walkers' middles, `fps` instants a second.

    `missed`: share of boxes that are not found; `false`: boxes of nobody a camera and frame; `side`: noise of a side
    as a share of the box's height. Everything is drawn from the yard's seed.
    """
    rng = np.random.default_rng((yard.seed, 23))
    scene.mkdir(parents=True, exist_ok=True)
    write_calibration(scene / "calibration.toml", yard)
    t = np.arange(int(yard.seconds * fps)) / fps
    states = np.stack([walker.states(t) for walker in yard.walkers], axis=1)  # (T, W, 4)
    height = np.array([walker.height for walker in yard.walkers])
    rows = ["frame,t,id,x,y,z,vx,vy,vz"]
    for frame, now in enumerate(states):
        for walker, (x, y, vx, vy) in zip(yard.walkers, now, strict=True):
            rows.append(f"{frame},{t[frame]},{walker.id},{x},{y},{walker.height / 2},{vx},{vy},0")
    (scene / "truth.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    for name, camera in yard.cameras.items():
        lines = []
        for frame, now in enumerate(states):
            found = _boxes(camera, now[:, :2], height)
            found = found[~_hidden(camera, found, now[:, :2]) & (rng.uniform(size=len(found)) > missed)]
            nobody = rng.uniform(-REACH_M, REACH_M, (rng.poisson(false), 2))
            found = np.concatenate([found, _boxes(camera, nobody, rng.normal(1.72, 0.2, len(nobody)))])
            found = found[np.isfinite(found).all(axis=1) & (found[:, 2] > 0) & (found[:, 0] < camera.size[0])]
            found = found + rng.normal(size=found.shape) * side * (found[:, 3:] - found[:, 1:2])
            lines += [f"{frame + 1},-1,{a:.2f},{b:.2f},{c - a:.2f},{d - b:.2f},1" for a, b, c, d in found]
        (scene / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _projection(camera: Camera) -> Array:
    return np.asarray(camera.K @ np.column_stack([camera.rotation, -camera.rotation @ camera.centre]))


def _boxes(camera: Camera, place: Array, height: Array) -> Array:
    """Boxes [u0, v0, u1, v1] (n, 4) px of people who stand at (n, 2) m."""
    foot = np.column_stack([place, np.zeros(len(place))])
    return people.boxes(_projection(camera), people.outline(foot, height, np.full(len(place), WIDTH_M)))


def _hidden(camera: Camera, box: Array, place: Array) -> np.ndarray:
    """Whose box (n,) lies for the most part behind a nearer one's."""
    depth = multiview.depths(_projection(camera), np.column_stack([place, np.zeros(len(place))]))
    low = np.maximum(box[:, None, :2], box[None, :, :2])
    high = np.minimum(box[:, None, 2:], box[None, :, 2:])
    share = np.prod(np.clip(high - low, 0, None), axis=-1) / np.prod(box[:, 2:] - box[:, :2], axis=-1)[:, None]
    return np.asarray(np.any((share > HIDDEN) & (depth[None] < depth[:, None]), axis=1))
