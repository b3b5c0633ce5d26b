"""Fusion of several cameras: `python benchmarks/fusion.py --seeds 10`.

First a simulation of walks before four cameras (pixels with noise, no pictures): every method's mean squared error as
a share of the centralised bound, and its normalised error squared. Then rendered yards (four cameras 640x480, 20 fps,
three people who cross in the middle) through the real command: who was found, hands changed, position error, cost.
"""

from __future__ import annotations

import argparse
import csv
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1]))

from samples.people import crossing, varied
from samples.yard import write_yard
from tests.test_fusion import simulate

METHODS = ("central", "closed-loop", "naive", "kim", "covariance-intersection")
GATE_M = 0.5
LINE = "{:<8} {:<24} {:6.1f} {:6.1f} {:8.3f} {:8.1f} {:7.4f} {:6.2f} {:8.2f} {:8.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--runs", type=int, default=200, help="of the simulation; 0 leaves it out")
    parser.add_argument("--varied", action="store_true", help="bodies, light, ground, cameras and noise drawn by lot")
    parser.add_argument("--method", choices=[*METHODS, "all"], default="closed-loop", help="of the rendered yards")
    args = parser.parse_args()
    if args.runs:
        found = simulate(list(METHODS), runs=args.runs)
        print(f"{'simulated':<24} {'MSE / bound':>12} {'NEES (6 is right)':>18}")
        for method in METHODS:
            print(f"{method:<24} {found[method][0] / found['central'][0]:12.3f} {found[method][1]:18.2f}")
    names = ("rendered", "method", "people", "tracks", "covered", "switches", "RMSE m", "NEES", "CPU / s", "wall / s")
    print("\n{:<8} {:<24} {:>6} {:>6} {:>8} {:>8} {:>7} {:>6} {:>8} {:>8}".format(*names))
    methods = METHODS if args.method == "all" else (args.method,)
    totals: dict[str, list[list[float]]] = {method: [] for method in methods}
    for seed in range(args.first, args.first + args.seeds):
        with tempfile.TemporaryDirectory() as folder:
            scene = Path(folder) / "scene"
            yard = varied(seed) if args.varied else crossing(seed)
            write_yard(yard, scene)
            for method in methods:
                spent = run(scene, Path(folder) / method, method)
                found = score(scene / "truth.csv", Path(folder) / method / "tracks.json")
                row = [len(yard.walkers), *found, *(seconds / yard.seconds for seconds in spent)]
                totals[method].append(row)
                print(LINE.format(f"seed {seed}", method, *row), flush=True)
    for method, rows in totals.items():
        print(LINE.format("mean", method, *np.mean(rows, axis=0)))
    tracks = args.seeds * int(totals[methods[0]][0][0])
    low, high = chi2.ppf([0.0005, 0.9995], 6 * tracks) / tracks
    print(f"99.9 % band of the NEES, were each of {tracks} tracks one independent sample: {low:.2f} to {high:.2f}")


def run(scene: Path, out: Path, method: str) -> tuple[float, float]:
    """The command on a scene, without video: CPU and wall seconds."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "visfuse_cli", "fuse-cameras", str(scene), "--out", str(out)]
    subprocess.run(
        [*command, "--set", f"fusion.method={method}", "--no-video", "--no-report", "-q"],
        check=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu, time.perf_counter() - begun


def score(truth_file: Path, tracks_file: Path) -> tuple[int, float, int, float, float]:
    """Tracks, share of true positions covered, hands changed, RMSE m, NEES."""
    truth: dict[int, dict[int, np.ndarray]] = {}
    with open(truth_file, newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            state = np.array([float(row[key]) for key in ("x", "y", "z", "vx", "vy", "vz")])
            truth.setdefault(int(row["frame"]), {})[int(row["id"])] = state
    tracks = json.loads(tracks_file.read_text(encoding="utf-8"))["tracks"]
    found: dict[int, list[tuple[int, np.ndarray, np.ndarray]]] = {}
    for track in tracks:
        for state in track["states"]:
            mean = np.array([*state["position"], *state["velocity"]])
            found.setdefault(state["frame"], []).append((track["id"], mean, np.array(state["covariance"])))
    held: dict[int, int] = {}
    switches, square, nees = 0, [], []
    for frame, people in sorted(truth.items()):
        there = found.get(frame, [])
        if not there:
            continue
        apart = np.array([[np.linalg.norm(p[:3] - mean[:3]) for _, mean, _ in there] for p in people.values()])
        for i, j in zip(*linear_sum_assignment(apart), strict=True):
            if apart[i, j] > GATE_M:
                continue
            who, (identity, mean, cov) = list(people)[i], there[j]
            switches += held.get(who, identity) != identity
            held[who] = identity
            off = mean - people[who]
            square.append(float(off[:3] @ off[:3]))
            nees.append(float(off @ np.linalg.solve(cov, off)))
    total = sum(len(people) for people in truth.values())
    return len(tracks), len(square) / total, switches, float(np.sqrt(np.mean(square))), float(np.mean(nees))


if __name__ == "__main__":
    main()
