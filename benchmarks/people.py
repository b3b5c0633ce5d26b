"""MOTA and IDF1 of `visfuse speed` against hand-made boxes: `python benchmarks/people.py RUN H.json BOXES.csv`.

Truth is where the homography maps the middle of a box's lower edge; both sides count only inside the annotated area and
in the annotated frames. Printed for all tracks of the run, and for those that were given a speed.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from visfuse_cli.evaluate.run import evaluate

AREA = ((-14.0, 8.0), (-16.0, 8.0))  # m, X and Y: people beyond are not annotated


def inside(place: np.ndarray) -> bool:
    return all(low <= value <= high for value, (low, high) in zip(place, AREA, strict=True))


def write_truth(boxes: Path, homography: Path, rate: float, out: Path) -> int:
    """Write truth.csv; the last annotated frame."""
    H = np.array(json.loads(homography.read_text())["H"]).reshape(3, 3)
    lines, last = ["frame,t,id,x,y,z,vx,vy,vz"], 0
    with open(boxes, newline="") as file:
        for row in csv.DictReader(file):
            u, v, w, h = (float(row[name]) for name in "xywh")
            x, y, scale = H @ [u + w / 2, v + h, 1.0]
            last = max(last, int(row["frame"]))
            if inside(np.array([x, y]) / scale):
                seconds = int(row["frame"]) / rate
                lines.append(f"{row['frame']},{seconds:.6f},{row['id']},{x / scale:.4f},{y / scale:.4f},,,,")
    out.write_text("\n".join(lines) + "\n")
    return last


def cut(run: Path, last: int, trusted_only: bool, out: Path) -> None:
    """The run's tracks.json with the states that count."""
    data = json.loads((run / "tracks.json").read_text())
    with open(run / "speeds.csv", newline="") as file:
        trusted = {int(row["track_id"]) for row in csv.DictReader(file)}
    for track in data["tracks"]:
        track["states"] = [s for s in track["states"] if s["frame"] <= last and inside(np.array(s["position"]))]
    data["tracks"] = [t for t in data["tracks"] if t["states"] and (not trusted_only or t["id"] in trusted)]
    out.mkdir()
    (out / "tracks.json").write_text(json.dumps(data))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("run", "homography", "boxes"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--gate", type=float, default=1.0, help="m")
    parser.add_argument("--rate", type=float, default=7.0, help="frames/s")
    options = parser.parse_args()
    print(f"{'tracks':>16} {'MOTA':>6} {'IDF1':>6} {'missed':>8} {'false':>8} {'switches':>8} {'true':>8}")
    with tempfile.TemporaryDirectory() as name:
        truth = Path(name) / "truth.csv"
        last = write_truth(options.boxes, options.homography, options.rate, truth)
        for trusted_only in (False, True):
            folder = Path(name) / f"run-{trusted_only}"
            cut(options.run, last, trusted_only, folder)
            found, _ = evaluate(folder, truth, None, options.gate, False)
            mota = 1 - (found["missed"] + found["false"] + found["switches"]) / found["true_states"]
            who = "given a speed" if trusted_only else "all"
            counts = "".join(f"{found[key]:>9d}" for key in ("missed", "false", "switches", "true_states"))
            print(f"{who:>16} {mota:6.3f} {found.get('idf1', float('nan')):6.3f}{counts}")


if __name__ == "__main__":
    main()
