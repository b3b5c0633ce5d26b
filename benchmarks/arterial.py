"""Speeds of the recorded arterial against a hand's timing: `python benchmarks/arterial.py RUN`.

RUN is `visfuse speed` on the recording's first 24 s. The timing was read by eye: where on the ground the rear tyres of
a car stand in two pictures, about 12 m apart, against a ruler drawn by the homography of the lane dashes. Half a pixel
is 0.05 m of ground at the near reading and 0.10 m at the far one: about 1 % of a speed.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path

import numpy as np

RATE = 25.0
BESIDE_M = 1.2  # from the tyres, across
READINGS = (  # frame, X, Y, frame, X, Y
    (30, 1.6, 7.25, 52, 1.6, 18.74),
    (96, 1.3, 6.90, 119, 1.4, 18.55),
    (155, 8.2, 6.93, 178, 9.1, 19.30),
    (174, 1.2, 7.05, 198, 1.3, 19.18),
    (194, 4.7, 6.75, 213, 5.2, 18.45),
    (195, 4.7, 7.40, 214, 5.2, 19.05),  # the same car one frame later: it drives 0.6 m a frame
    (286, 5.0, 7.18, 311, 4.9, 19.15),
    (338, 4.7, 7.12, 366, 4.1, 18.98),
    (382, -0.7, 7.50, 402, -1.0, 19.15),
    (430, 3.6, 7.48, 459, 2.9, 19.13),
    (459, 0.2, 7.56, 485, 0.0, 18.96),
    (477, 5.1, 7.15, 507, 4.9, 18.95),
    (510, -1.2, 7.15, 539, -1.4, 19.10),
    (518, 4.9, 7.25, 549, 4.9, 18.95),
    (537, 8.5, 7.26, 571, 7.5, 19.25),
    (557, 4.3, 7.08, 591, 4.5, 19.00),
)


def compared(run: Path) -> list[tuple[int, float, float, int | None, float]]:
    """Of each timing: first frame, lane X (m), timed km/h, and the track with a row that is there and its km/h."""
    with open(run / "speeds.csv", newline="") as file:
        trusted = {int(row["track_id"]) for row in csv.DictReader(file)}
    tracks = [t for t in json.loads((run / "tracks.json").read_text())["tracks"] if t["id"] in trusted]
    paths = {t["id"]: {s["frame"]: np.array(s["position"][:2]) for s in t["states"]} for t in tracks}
    half = {t["id"]: t["summary"]["size"][0] / 2 for t in tracks}
    found: list[tuple[int, float, float, int | None, float]] = []
    for first, x, y, last, x_last, y_last in READINGS:
        seconds = (last - first) / RATE
        timed = float(np.hypot(x_last - x, y_last - y)) / seconds * 3.6
        there = [
            (float(abs(path[first][1] - half[k] - y)), k)
            for k, path in paths.items()
            if first in path and last in path and abs(path[first][0] - x) < BESIDE_M
        ]
        behind, best = min(there, default=(np.inf, -1))
        if best < 0 or behind > half[best]:
            found.append((first, x, timed, None, np.nan))
        else:
            way = float(np.linalg.norm(paths[best][last] - paths[best][first]))
            found.append((first, x, timed, best, way / seconds * 3.6))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    lines = compared(parser.parse_args().run)
    print(f"{'frame':>5} {'lane X':>6} | {'timed':>6} {'track':>5} {'ours':>6} {'off':>6}")
    for first, x, timed, track, ours in lines:
        told = f"{'none':>5}" if track is None else f"{track:>5} {ours:>6.2f} {100 * (ours / timed - 1):>+5.1f}%"
        print(f"{first:>5} {x:>6.1f} | {timed:>6.2f} {told}")
    errors = [abs(ours / timed - 1) for _, _, timed, track, ours in lines if track is not None]
    within = ", ".join(f"{sum(e <= limit for e in errors)} within {100 * limit:.0f} %" for limit in (0.02, 0.03, 0.04))
    print(f"{len(lines)} timings: {len(errors)} found; {within}")


if __name__ == "__main__":
    main()
