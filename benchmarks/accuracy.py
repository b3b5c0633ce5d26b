"""Errors of `visfuse speed` on rendered roads with known truth: `python benchmarks/accuracy.py --seeds 10`.

A vehicle is found when a row's track lies within 2 m of it for half of the time it is in the picture; the truth of
a row is the vehicle's mean speed over the row's own stretch.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from samples.files import write_scene
from samples.road import KINDS
from samples.score import matches


def visfuse(*arguments: object) -> None:
    subprocess.run([sys.executable, "-m", "visfuse_cli", *map(str, arguments), "-q"], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=15)
    parser.add_argument("--kind", choices=sorted(KINDS), default="free-flow")
    options = parser.parse_args()
    print(
        f"{'seed':>5} {'in picture':>10} {'found':>6} {'other rows':>10} {'mean km/h':>10} {'worst':>6} {'in 95 %':>8}"
    )
    pooled: list[tuple[float, bool]] = []
    seen = found_all = others_all = 0
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            write_scene(KINDS[options.kind](seed, options.seconds), folder)
            visfuse("calibrate-homography", "--points", folder / "points.csv", "--out", folder / "H.json")
            visfuse(
                "speed", folder / "clip.mp4", "--homography", folder / "H.json", "--out", folder / "run", "--no-video"
            )
            found = matches(folder / "run", folder / "truth.csv")
            with open(folder / "truth.csv", newline="") as file:
                frames = [row["id"] for row in csv.DictReader(file)]
        present = {vehicle for vehicle in frames if frames.count(vehicle) >= 25}
        good = [(row, true) for row, true, share, _ in found if share >= 0.5]
        errors = [float(row["speed_kmh"]) - true for row, true in good]
        inside = [float(row["ci95_low_kmh"]) <= true <= float(row["ci95_high_kmh"]) for row, true in good]
        others = sum(share < 0.3 for *_, share, _ in found)
        vehicles = {vehicle for *_, share, vehicle in found if share >= 0.5}
        pooled += list(zip(np.abs(errors), inside, strict=True))
        seen, found_all, others_all = seen + len(present), found_all + len(vehicles), others_all + others
        print(line(str(seed), len(present), len(vehicles), others, np.abs(errors), inside), flush=True)
    print(line("all", seen, found_all, others_all, np.array([e for e, _ in pooled]), [i for _, i in pooled]))


def line(name: str, present: int, found: int, others: int, errors: np.ndarray, inside: list[bool]) -> str:
    """One row of the table."""
    mean, worst = (float(errors.mean()), float(errors.max())) if len(errors) else (np.nan, np.nan)
    share = float(np.mean(inside)) if inside else np.nan
    return f"{name:>5} {present:>10} {found:>6} {others:>10} {mean:>10.2f} {worst:>6.2f} {share:>8.0%}"


if __name__ == "__main__":
    main()
