"""Fusion of boxes: `python benchmarks/fusion_boxes.py [SCENE]`.

How the time of a run grows with cameras and with people, on simulated boxes; two people who pass each other before a
detector that misses and invents many, by the way of association; and, where a scene with boxes and truth.csv is given,
a naive rival on it: each box's foot on the ground, greedy clusters of two cameras or more.
"""

from __future__ import annotations

import csv
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

sys.path.insert(0, str(Path(__file__).parents[1]))

from samples.detector import passing, write_boxes
from samples.people import crossing
from samples.yard import write_calibration
from visfuse_cli.files.detections import read_mot
from visfuse_cli.files.multi_calibration import read_views
from visfuse_cli.maths import multiview, people
from visfuse_cli.records import Array

FRAMES, FPS = 60, 10
PASSES = 12
CLUSTER_M, GATE_M = 0.7, 0.5


def main() -> None:
    """Print all."""
    print(f"two people pass each other, three cameras, 30 % missed, 2 false boxes a picture, {PASSES} scenes")
    for association in ("one-to-one", "jpda"):
        scores = np.array([passed(seed, association) for seed in range(PASSES)])
        print(
            f"{association:>12}: MODA {scores[:, 0].mean():.3f}, rms {np.sqrt(np.mean(scores[:, 1] ** 2)):.3f} m,"
            f" exchanged in {np.count_nonzero(scores[:, 2])}",
            flush=True,
        )
    print("cameras people  CPU s a run")
    for cameras, count in ((2, 6), (4, 6), (8, 6), (16, 6), (6, 1), (6, 5), (6, 12), (6, 25), (6, 50)):
        print(f"{cameras:7d} {count:6d} {cpu_seconds(cameras, count):8.2f}", flush=True)
    if len(sys.argv) > 1:
        print("rival: MODA {:.3f}, median {:.3f} m".format(*score(rival(Path(sys.argv[1])), Path(sys.argv[1]))))


def cpu_seconds(cameras: int, count: int) -> float:
    """Of the real command on simulated boxes of people on a grid who all walk slowly."""
    yard = crossing(1, cameras=cameras)
    rng = np.random.default_rng((cameras, count))
    side = int(np.ceil(np.sqrt(count)))
    start = np.array([[k % side, k // side] for k in range(count)]) * 1.2 - 0.6 * (side - 1)
    speed = rng.normal(0, 0.1, (count, 2))
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        scene.mkdir()
        write_calibration(scene / "calibration.toml", yard)
        views, _ = read_views(scene)
        for view in views:
            rows = []
            for frame in range(FRAMES):
                foot = np.column_stack([start + speed * frame / FPS, np.zeros(count)])
                outline = people.outline(foot, np.full(count, 1.72), np.full(count, 0.55))
                for box in people.boxes(multiview.projection(view), outline):
                    if np.isfinite(box).all():
                        u0, v0, u1, v1 = box + rng.normal(0, 1, 4)
                        rows.append(f"{frame + 1},-1,{u0:.2f},{v0:.2f},{u1 - u0:.2f},{v1 - v0:.2f},1")
            (scene / f"{view.name}.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "visfuse_cli", "fuse-cameras", str(scene), "--out", str(scene / "run")]
        subprocess.run([*command, "--set", f"video.fps={FPS}", "--no-report", "-q"], check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def passed(seed: int, association: str) -> tuple[float, float, int]:
    """MODA, position error (m rms) and how often a person's track changed, of the real command on one scene."""
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        write_boxes(passing(seed), scene, fps=5, missed=0.3, false=2.0)
        command = [sys.executable, "-m", "visfuse_cli", "fuse-cameras", str(scene), "--out", str(scene / "run")]
        told = ["video.fps=5", f"sight.association={association}", "sight.detected=0.7", "sight.false_boxes=2"]
        options = [part for each in told for part in ("--set", each)]
        subprocess.run([*command, *options, "--no-report", "-q"], check=True)
        places: dict[int, dict[int, Array]] = {}
        for track in json.loads((scene / "run" / "tracks.json").read_text(encoding="utf-8"))["tracks"]:
            for state in track["states"]:
                places.setdefault(state["frame"], {})[track["id"]] = np.array(state["position"][:2])
        truth = _truth(scene)
    hits, wrong, total, exchanged, errors = 0, 0, 0, 0, []
    last: dict[int, int] = {}
    for frame, there in truth.items():
        ids, here = list(places.get(frame, {})), np.array(list(places.get(frame, {}).values())).reshape(-1, 2)
        apart = np.linalg.norm(np.array(there)[:, None] - here[None], axis=-1)
        held = np.array([[last.get(i) == k for k in ids] for i in range(len(there))]).reshape(apart.shape)
        cost = np.where(apart < GATE_M, apart - held, 1e3)  # who was paired stays so while it is near enough
        pairs = [(i, j) for i, j in zip(*linear_sum_assignment(cost), strict=True) if apart[i, j] < GATE_M]
        exchanged += sum(last.get(i, ids[j]) != ids[j] for i, j in pairs)
        last |= {i: ids[j] for i, j in pairs}
        errors += [apart[i, j] for i, j in pairs]
        hits, wrong, total = hits + len(pairs), wrong + len(here) - len(pairs), total + len(there)
    return (hits - wrong) / total, float(np.sqrt(np.mean(np.square(errors)))), exchanged


def rival(scene: Path) -> dict[int, Array]:
    """Places (k, 2) m by frame: feet of all boxes, those near to each other joined, two cameras at least."""
    views, _ = read_views(scene)
    feet: dict[int, list[tuple[int, Array]]] = {}
    for camera, view in enumerate(views):
        for frame, boxes in read_mot(scene / f"{view.name}.txt").items():
            foot = np.column_stack([boxes[:, 0] + boxes[:, 2] / 2, boxes[:, 1] + boxes[:, 3]])
            places, _ = multiview.on_plane(multiview.projection(view), foot)
            feet.setdefault(frame, []).extend((camera, place) for place in places[np.isfinite(places).all(axis=1)])
    found = {}
    for frame, seen in feet.items():
        clusters: list[tuple[set[int], list[Array]]] = []
        for camera, place in seen:
            near = [
                c for c in clusters if camera not in c[0] and np.linalg.norm(np.mean(c[1], axis=0) - place) < CLUSTER_M
            ]
            if near:
                best = min(near, key=lambda c: float(np.linalg.norm(np.mean(c[1], axis=0) - place)))
                best[0].add(camera)
                best[1].append(place)
            else:
                clusters.append(({camera}, [place]))
        found[frame] = np.array([np.mean(c[1], axis=0) for c in clusters if len(c[0]) > 1]).reshape(-1, 2)
    return found


def score(found: dict[int, Array], scene: Path) -> tuple[float, float]:
    """MODA and median error (m) at GATE_M against truth.csv."""
    hits, wrong, total, errors = 0, 0, 0, []
    for frame, there in _truth(scene).items():
        here = found.get(frame, np.zeros((0, 2)))
        apart = np.linalg.norm(np.array(there)[:, None] - here[None], axis=-1)
        pairs = zip(*linear_sum_assignment(np.where(apart < GATE_M, apart, 1e3)), strict=True)
        near = [apart[i, j] for i, j in pairs if apart[i, j] < GATE_M]
        errors += near
        hits, wrong, total = hits + len(near), wrong + len(here) - len(near), total + len(there)
    return (hits - wrong) / total, float(np.median(errors))


def _truth(scene: Path) -> dict[int, list[list[float]]]:
    """Where everybody is (m), by frame, in the order of truth.csv."""
    truth: dict[int, list[list[float]]] = {}
    with open(scene / "truth.csv", newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            truth.setdefault(int(row["frame"]), []).append([float(row["x"]), float(row["y"])])
    return truth


if __name__ == "__main__":
    main()
