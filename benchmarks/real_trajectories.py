"""Filters on real trajectories: `python benchmarks/real_trajectories.py [--files even|all] [--noise 0.1]`.

Recorded paths of cars, a cart and people (`../shared/data/trajectories`), noise added to them; every filter of
`visfuse speed` with its shipped settings, and the plain constant-velocity Kalman filter on positions, tuned on the same
files as the shipped settings. The error of the filtered and of the smoothed position, and of the position predicted
0.5 s and 1 s ahead (RMS, m), cars, cart and people apart, tracks weighted by their length. Every second file was used
for tuning; the table is of the others unless `--files tuning`.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

sys.path.insert(0, str(Path(__file__).parents[1]))

from visfuse_cli.maths import gaussian, motion
from visfuse_cli.records import Gaussian
from visfuse_cli.tracking import dynamics as tools
from visfuse_cli.tracking.settings import FilterSettings, TargetSettings

DATA = Path(__file__).parents[2] / "shared" / "data" / "trajectories"
KINDS = ("ekf", "fading", "cuf", "fading-cuf", "imm")
AHEAD = (0.5, 1.0)  # s
WARM_UP_S = 1.0
LEAST_S, LEAST_M = 3.0, 3.0  # shorter tracks, and what stands, are left out
HEADING_SIGMA = np.deg2rad(2.0)
LENGTH = {"cars": 4.2, "cart": 2.4, "people": 0.5}
PLAIN_Q = {"cars": 0.5, "cart": 0.25, "people": 0.1}  # m^2 s^-3 of the plain filter, the best on the tuning files


@dataclass(frozen=True)
class Track:
    """One recorded path: times (T,) s, position (T, 2) m, heading (T,) rad."""

    t: np.ndarray
    place: np.ndarray
    heading: np.ndarray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", choices=("others", "tuning", "all"), default="others")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.1], help="m on each coordinate")
    parser.add_argument("--data", type=Path, default=DATA)
    args = parser.parse_args()
    if not args.data.is_dir():
        sys.exit(f"no trajectories in {args.data}")
    for sigma in args.noise:
        for group in LENGTH:
            tracks = list(read(args.data, group, args.files))
            seconds = sum(track.t[-1] - track.t[0] for track in tracks)
            print(f"\n{group}: {len(tracks)} tracks, {seconds:.0f} s, noise {sigma:g} m")
            print(f"{'':<14}{'filtered':>9}{'smoothed':>9}" + "".join(f"{f'{s:g} s':>9}" for s in AHEAD) + "   m RMS")
            plain = plain_errors(tracks, sigma, PLAIN_Q[group])
            print(f"{'plain CV':<14}{plain[0]:9.3f}{plain[1]:9.3f}" + "".join(f"{e:9.3f}" for e in plain[2:]))
            for kind in KINDS:
                row = errors(tracks, sigma, group, FilterSettings(kind=kind))
                print(f"{kind:<14}{row[0]:9.3f}{row[1]:9.3f}" + "".join(f"{e:9.3f}" for e in row[2:]))


def read(folder: Path, group: str, files: str) -> Iterator[Track]:
    """The tracks of one group in every second file, or in all."""
    patterns = {"cars": ["kitti-*"], "cart": ["golfcart-*"], "people": ["kitti-*", "people-*"]}[group]
    paths = sorted(path for pattern in patterns for path in folder.glob(pattern + ".csv"))
    chosen = {"others": paths[1::2], "tuning": paths[::2], "all": paths}[files]
    for path in chosen:
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        wanted = {"cars": {"Car", "Van", "Truck"}, "people": {"Pedestrian"}}.get(group)
        own: dict[str, list[tuple[float, float, float]]] = {}
        for row in rows:
            if wanted is None or "kind" not in row or row["kind"] in wanted:
                own.setdefault(row["id"], []).append((float(row["t"]), float(row["X"]), float(row["Y"])))
        for points in own.values():
            yield from _whole(np.array(points))


def _whole(points: np.ndarray) -> Iterator[Track]:
    """Stretches of one path without gaps that are long enough and go somewhere."""
    t = points[:, 0]
    if len(t) < 4:
        return
    step = float(np.median(np.diff(t)))
    for part in np.split(points, np.flatnonzero(np.diff(t) > 1.6 * step) + 1):
        if part[-1, 0] - part[0, 0] < LEAST_S or np.ptp(part[:, 1:], axis=0).max() < LEAST_M:
            continue
        place = part[:, 1:] - part[0, 1:]
        window = max(5, 2 * round(0.4 / step) + 1)
        velocity = savgol_filter(place, min(window, len(place) // 2 * 2 - 1), 2, deriv=1, delta=step, axis=0)
        speed = np.hypot(*velocity.T)
        heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        moving = np.flatnonzero(speed > 0.5)
        if not len(moving):
            continue
        last = np.maximum(np.searchsorted(moving, np.arange(len(place)), side="right") - 1, 0)
        yield Track(part[:, 0], place, heading[moving[last]])


def errors(tracks: list[Track], sigma: float, group: str, settings: FilterSettings) -> np.ndarray:
    """RMS (4,) of filtered, smoothed, and predicted positions with one of the tool's filters."""
    steers = group != "people"
    dynamics = tools.for_target(TargetSettings(motion="bicycle" if steers else "constant-velocity"), settings)
    rng = np.random.default_rng(0)
    z = [_measured(track, sigma, rng) for track in tracks]
    R = np.diag([sigma**2, sigma**2, HEADING_SIGMA**2])[: 3 if steers else 2, : 3 if steers else 2]
    steps = []
    for track, seen in zip(tracks, z, strict=True):
        k = min(3, len(track.t) - 1)
        velocity = (seen[k, :2] - seen[0, :2]) / (track.t[k] - track.t[0])
        steps.append([tools.first(dynamics, dynamics.begin(seen[0], velocity))])
    return _run(tracks, z, steps, dynamics, R, LENGTH[group])


def _run(
    tracks: list[Track], z: list[np.ndarray], steps: list[list[tools.Step]], dynamics: tools.Dynamics, R, length: float
) -> np.ndarray:
    squares: list[list[float]] = [[], [], *[[] for _ in AHEAD]]
    width = len(R)
    for k in range(1, max(len(track.t) for track in tracks)):
        live = [i for i, track in enumerate(tracks) if k < len(track.t)]
        latest = [steps[i][-1] for i in live]
        dt = np.array([tracks[i].t[k] - tracks[i].t[k - 1] for i in live])
        expected = tools.predict(dynamics, latest, dt, np.full(len(live), length))
        for i, prediction in zip(live, expected, strict=True):
            steps[i].append(tools.take(dynamics, prediction, z[i][k, :width], R))
        for a, later in enumerate(AHEAD):
            told = tools.predict(
                dynamics, [steps[i][-1] for i in live], np.full(len(live), later), np.full(len(live), length)
            )
            for i, prediction in zip(live, told, strict=True):
                track = tracks[i]
                when = track.t[k] + later
                if track.t[k] - track.t[0] < WARM_UP_S or when > track.t[-1]:
                    continue
                truth = [np.interp(when, track.t, track.place[:, c]) for c in (0, 1)]
                squares[2 + a].append(float(np.sum((prediction.prior.mean[:2] - truth) ** 2)))
    for track, own in zip(tracks, steps, strict=True):
        warm = track.t - track.t[0] >= WARM_UP_S
        filtered = np.array([step.posterior.mean[:2] for step in own])
        smoothed = tools.smooth(dynamics, own).mean[:, :2]
        for row, found in zip(squares, (filtered, smoothed), strict=False):
            row += np.sum((found - track.place)[warm] ** 2, axis=1).tolist()
    return np.sqrt([np.mean(row) for row in squares])


def plain_errors(tracks: list[Track], sigma: float, q: float) -> np.ndarray:
    """The same of a plain Kalman filter with constant velocity on positions."""
    plain = tools.Dynamics(
        H=np.eye(2, 4),
        alpha=(1.0, 1.0),
        angles_z=(),
        angles_x=(),
        advance=lambda x, cov, dt, length: (
            gaussian.times(motion.constant_velocity(dt), x),
            motion.constant_velocity(dt),
            motion.constant_velocity_noise(dt, q),
        ),
        begin=lambda pose, velocity: Gaussian(np.append(pose[:2], velocity), np.diag([0.3, 0.3, 2.0, 2.0]) ** 2),
        planar=lambda x: (x, np.eye(4)),
        heading=lambda x: np.arctan2(x[..., 3], x[..., 2]),
        measured=lambda pose, cov: (pose[:2], cov[:2, :2]),
        fades=False,
    )
    rng = np.random.default_rng(0)
    z = [_measured(track, sigma, rng) for track in tracks]
    steps = []
    for track, seen in zip(tracks, z, strict=True):
        k = min(3, len(track.t) - 1)
        velocity = (seen[k, :2] - seen[0, :2]) / (track.t[k] - track.t[0])
        steps.append([tools.first(plain, plain.begin(seen[0], velocity))])
    return _run(tracks, z, steps, plain, sigma**2 * np.eye(2), 1.0)


def _measured(track: Track, sigma: float, rng: np.random.Generator) -> np.ndarray:
    noise = rng.normal(size=(len(track.t), 3)) * [sigma, sigma, HEADING_SIGMA]
    return np.column_stack([track.place, track.heading]) + noise


if __name__ == "__main__":
    main()
