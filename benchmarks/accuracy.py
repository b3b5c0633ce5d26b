"""Errors of `visfuse speed` and of a naive rival on rendered roads: `python benchmarks/accuracy.py --seeds 10`.

A vehicle is found when a row's track lies within 2 m of it for half of the time it is in the picture; a row is false
when its track keeps to no vehicle for a third of that. The truth of a row is the vehicle's mean speed over the row's
own stretch. The rival: MOG2, box bottoms, nearest neighbour, a straight line fitted (`rival.py`); it follows the near
edge of a vehicle and not its middle, so that it is granted 4 m.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from samples.files import write_scene
from samples.road import KINDS
from samples.score import heading_errors, matches, rows

LEAST_FRAMES = 25  # in the picture, to count as a vehicle


@dataclass
class Score:
    """What one side made of some scenes."""

    found: int = 0
    rows: int = 0
    false: int = 0
    errors: list[float] = field(default_factory=list)
    inside: list[bool] = field(default_factory=list)
    headings: list[float] = field(default_factory=list)  # degrees off, a figure for each measured frame

    def add(self, other: Score) -> None:
        self.found += other.found
        self.rows += other.rows
        self.false += other.false
        self.errors += other.errors
        self.inside += other.inside
        self.headings += other.headings

    def __str__(self) -> str:
        mean, worst = (np.mean(self.errors), np.max(self.errors)) if self.errors else (np.nan, np.nan)
        share = f"{np.mean(self.inside):>6.0%}" if self.inside else f"{'-':>6}"
        heading = f"{np.sqrt(np.mean(np.square(self.headings))):>7.1f}" if self.headings else f"{'-':>7}"
        return f"{self.found:>6} {self.rows:>5} {self.false:>5} {mean:>6.2f} {worst:>6.2f} {share} {heading}"


def score(run: Path, truth: Path, reach_m: float = 2.0, headings: bool = True) -> Score:
    """Count the rows of a run that belong to a vehicle, and measure them; the rival tells no headings."""
    matched = matches(run, truth, reach_m)
    good = [(row, true) for row, true, share, _ in matched if share >= 0.5]
    return Score(
        found=len({vehicle for *_, share, vehicle in matched if share >= 0.5}),
        rows=len(matched),
        false=sum(share < 1 / 3 for *_, share, _ in matched),
        errors=[abs(float(row["speed_kmh"]) - true) for row, true in good],
        inside=[
            float(row["ci95_low_kmh"]) <= true <= float(row["ci95_high_kmh"])
            for row, true in good
            if row.get("ci95_low_kmh")
        ],
        headings=heading_errors(run, truth) if headings else [],
    )


def python(*arguments: object) -> None:
    subprocess.run([sys.executable, *map(str, arguments)], check=True)


def scene(kind: str, seed: int, seconds: float, folder: Path) -> Path:
    """A folder with a rendered scene and its calibration, made where it is not there yet."""
    if not (folder / "H.json").exists():
        write_scene(KINDS[kind](seed, seconds), folder)
        points, H = folder / "points.csv", folder / "H.json"
        python("-m", "visfuse_cli", "calibrate-homography", "--points", points, "--out", H, "-q")
    return folder


def measured(folder: Path, out: Path) -> tuple[Score, Score]:
    """What visfuse and the rival make of one scene."""
    clip, H, truth = folder / "clip.mp4", folder / "H.json", folder / "truth.csv"
    switches = ("--no-video", "--no-report", "-q")
    python("-m", "visfuse_cli", "speed", clip, "--homography", H, "--out", out / "run", *switches)
    python(Path(__file__).parent / "rival.py", clip, H, out / "rival")
    return score(out / "run", truth), score(out / "rival", truth, 4.0, headings=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=15)
    parser.add_argument("--kind", choices=sorted(KINDS), default="free-flow")
    parser.add_argument("--scenes", type=Path, help="folder in which rendered scenes are kept and used again")
    options = parser.parse_args()
    columns = f"{'found':>6} {'rows':>5} {'false':>5} {'mean':>6} {'worst':>6} {'in 95%':>6} {'heading':>7}"
    print(f"{'':>5} {'':>8} | {'visfuse (km/h, degrees)':^47} | {'rival (km/h)':^47}")
    print(f"{'seed':>5} {'vehicles':>8} | {columns} | {columns}")
    all_ours, all_rivals, vehicles = Score(), Score(), 0
    for seed in range(options.first, options.first + options.seeds):
        with tempfile.TemporaryDirectory() as name:
            kept = options.scenes or Path(name)
            folder = scene(options.kind, seed, options.seconds, kept / f"{options.kind}-{seed}")
            ours, rivals = measured(folder, Path(name))
            frames = [row["id"] for row in rows(folder / "truth.csv")]
        present = sum(frames.count(vehicle) >= LEAST_FRAMES for vehicle in set(frames))
        print(f"{seed:>5} {present:>8} | {ours} | {rivals}", flush=True)
        all_ours.add(ours)
        all_rivals.add(rivals)
        vehicles += present
    print(f"{'all':>5} {vehicles:>8} | {all_ours} | {all_rivals}")


if __name__ == "__main__":
    main()
