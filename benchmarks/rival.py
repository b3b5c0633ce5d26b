"""The naive rival of `visfuse speed`: MOG2, box bottoms, nearest neighbour, a line fit. It stands beside every figure.

`python benchmarks/rival.py CLIP H.json OUT` writes OUT/speeds.csv and OUT/tracks.json in the columns that are scored.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import cv2
import numpy as np

MIN_AREA, REACH_M, PATIENCE, MIN_FRAMES, MIN_WAY_M = 150, 2.5, 10, 10, 5.0


def follow(clip: Path, homography: Path) -> list[np.ndarray]:
    """Tracks (T, 4) of frame, t, X, Y: the middle of each foreground box's lower edge on the ground."""
    H = np.array(json.loads(homography.read_text())["H"]).reshape(3, 3)
    capture = cv2.VideoCapture(str(clip))
    rate = capture.get(cv2.CAP_PROP_FPS)
    model = cv2.createBackgroundSubtractorMOG2(500, 16, True)
    live: list[list[tuple[int, float, float, float]]] = []
    done: list[np.ndarray] = []
    number = -1
    while True:
        number += 1
        ok, image = capture.read()
        if not ok:
            break
        mask = cv2.compare(model.apply(image), 255, cv2.CMP_EQ)
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3)))
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((9, 9)))
        _, _, boxes, _ = cv2.connectedComponentsWithStats(mask)
        feet = np.array([(x + w / 2, y + h) for x, y, w, h, area in boxes[1:] if area >= MIN_AREA], float)
        ground = cv2.perspectiveTransform(feet.reshape(-1, 1, 2), H).reshape(-1, 2) if len(feet) else feet
        free = set(range(len(ground)))
        for track in live:
            here = ground_after(track, number / rate)
            near = min(free, key=lambda k: float(np.hypot(*(ground[k] - here))), default=None)
            if near is not None and np.hypot(*(ground[near] - here)) < REACH_M:
                free.discard(near)
                track.append((number, number / rate, *ground[near]))
        live += [[(number, number / rate, *ground[k])] for k in free]
        done += [np.array(track) for track in live if number - track[-1][0] > PATIENCE]
        live = [track for track in live if number - track[-1][0] <= PATIENCE]
    done += [np.array(track) for track in live]
    return [t for t in done if len(t) >= MIN_FRAMES and np.hypot(*(t[-1, 2:] - t[0, 2:])) >= MIN_WAY_M]


def ground_after(track: list[tuple[int, float, float, float]], t: float) -> np.ndarray:
    """Where a track is expected at `t` by its last ten points."""
    last = np.array(track[-10:])
    velocity = (last[-1, 2:] - last[0, 2:]) / max(last[-1, 1] - last[0, 1], 1e-9) if len(last) > 2 else np.zeros(2)
    return np.asarray(last[-1, 2:] + velocity * (t - last[-1, 1]))


def write(tracks: list[np.ndarray], out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    with open(out / "speeds.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["track_id", "t_start", "t_end", "speed_kmh", "ci95_low_kmh", "ci95_high_kmh"])
        for number, track in enumerate(tracks):
            speed = 3.6 * float(np.hypot(*np.polyfit(track[:, 1], track[:, 2:], 1)[0]))
            table.writerow([number, track[0, 1], track[-1, 1], speed, speed, speed])
    states = [[{"frame": int(f), "t": t, "position": [x, y]} for f, t, x, y in track] for track in tracks]
    (out / "tracks.json").write_text(json.dumps({"tracks": [{"id": k, "states": s} for k, s in enumerate(states)]}))


if __name__ == "__main__":
    write(follow(Path(sys.argv[1]), Path(sys.argv[2])), Path(sys.argv[3]))
