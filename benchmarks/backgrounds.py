"""The three backgrounds beside one another: `python benchmarks/backgrounds.py --seeds 3 [--data ../shared/data]`.

Pixels: precision and recall of the foreground against the rendered silhouettes, frame by frame, nothing kept out of the
model. Runs: `visfuse speed` on the same rendered roads and, where there is one, on the recorded arterial, of which only
the number of rows is known.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from accuracy import Score, python, score

from samples.files import write_scene
from samples.render import frames
from samples.road import free_flow
from samples.scene import NEAREST_DEPTH, Scene
from visfuse_cli.vision.background import FOREGROUND, Background
from visfuse_cli.vision.empty import empty_picture

MODELS = ("mog2", "knn", "kalman")
SECONDS, ARTERIAL_S = 12.0, 24.0


def silhouettes(scene: Scene) -> Iterator[np.ndarray]:
    """Where vehicles are (H, W), frame by frame."""
    states = [vehicle.trajectory(scene.times) for vehicle in scene.vehicles]
    for index in range(scene.n_frames):
        mask = np.zeros(scene.camera.size[::-1], np.uint8)
        for vehicle, state in zip(scene.vehicles, states, strict=True):
            corners = vehicle.corners(state[index])
            if scene.camera.depth(corners).min() > NEAREST_DEPTH:
                outline = scene.camera.project(corners).astype(np.float32)
                hull = cv2.convexHull(np.clip(outline, -9000, 9000))
                cv2.fillConvexPoly(mask, np.round(hull * 16).astype(np.int32), 1, shift=4)
        yield mask > 0


def pixels(scene: Scene) -> dict[str, np.ndarray]:
    """Of each model how many pixels are right, taken too many, and missed."""
    pictures = list(frames(scene))
    empty = empty_picture(pictures[:: max(1, len(pictures) // 31)])
    backgrounds = {name: Background(name, 16.0, 0.45, 60.0) for name in MODELS}
    found = {name: np.zeros(3) for name in MODELS}
    for background in backgrounds.values():
        background.start(empty)
    for index, (picture, there) in enumerate(zip(pictures, silhouettes(scene), strict=True)):
        for name, background in backgrounds.items():
            seen = background.detect(picture) == FOREGROUND
            background.learn(picture, float(scene.times[index]), [])
            found[name] += (seen & there).sum(), (seen & ~there).sum(), (there & ~seen).sum()
    return found


def measured(model: str, folder: Path, clip: Path, *options: object) -> tuple[Path, float]:
    """A run with one model, and the ms a frame that looking and learning took of it."""
    run = folder / f"{clip.parent.name}-{model}"
    settings = ("--set", f"background.model={model}", "--no-video", "--no-report", "-q")
    python("-m", "visfuse_cli", "speed", clip, "--homography", folder / "H.json", "--out", run, *settings, *options)
    document = json.loads((run / "run.json").read_text())
    stages = document["seconds_per_stage"]
    return run, 1000 * (stages["detect"] + stages["learn"]) / document["counts"]["frames"]


def calibrated(points: Path, folder: Path) -> None:
    python("-m", "visfuse_cli", "calibrate-homography", "--points", points, "--out", folder / "H.json", "-q")


def arterial(source: Path) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        calibrated(source / "points.csv", folder)
        for model in MODELS:
            run, spent = measured(model, folder, source / "clip.mp4", "--end", ARTERIAL_S)
            rows, rejected = (len((run / name).read_text().splitlines()) - 1 for name in ("speeds.csv", "rejected.csv"))
            print(f"arterial, {ARTERIAL_S:.0f} s  {model:>7}: {rows} rows, {rejected} rejected, {spent:.1f} ms a frame")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    options = parser.parse_args()
    scores = {name: Score() for name in MODELS}
    spent: dict[str, list[float]] = {name: [] for name in MODELS}
    areas = {name: np.zeros(3) for name in MODELS}
    for seed in range(options.seeds):
        scene = free_flow(seed, SECONDS)
        for name, counts in pixels(scene).items():
            areas[name] += counts
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            write_scene(scene, folder / "scene")
            calibrated(folder / "scene" / "points.csv", folder)
            for model in MODELS:
                run, ms = measured(model, folder, folder / "scene" / "clip.mp4")
                scores[model].add(score(run, folder / "scene" / "truth.csv"))
                spent[model].append(ms)
    print(f"{'':>8} precision recall |  found false   mean  worst in 95% | ms a frame")
    for name in MODELS:
        right, many, missed = areas[name]
        share = f"{right / (right + many):>9.3f} {right / (right + missed):>6.3f}"
        print(f"{name:>8} {share} | {scores[name]} | {np.mean(spent[name]):.1f}", flush=True)
    if (options.data / "speed-arterial").is_dir():
        arterial(options.data / "speed-arterial")


if __name__ == "__main__":
    main()
