"""Moving heads: `python benchmarks/moving.py --seeds 10 [--first 0] [--keep DIR] [--only PART ...]`

Rendered rooms (a target 3-6 m away that goes straight, turns and leaves; two people who cross; nobody at all, seen by
unlike cameras), the recorded street, rendered pan-tilt heads (one walker; three people who meet), the CPU time of each
frame with the video written, and memory over length, all through the real command. `--first` is the first seed,
`--keep` keeps the rendered scenes and takes those that are there, `--fps` renders the rooms at another rate.
"""

from __future__ import annotations

import argparse
import csv
import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from samples.gaze import GazeScene, three, write_gaze, yard
from samples.head import HeadScene, Walk, room, visit, write_head

Array = NDArray[np.float64]
STREET = Path(__file__).parents[2] / "shared" / "data" / "imm-street"
MODELS = ("imm", "drifting", "cv", "ca", "periodic")
TURNING = 0.25  # rad/s of the true course, from which on a target turns
PARTS = ("visits", "crossings", "still", "street", "gaze", "meeting", "speed", "memory")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--fps", type=int, default=15, help="frame rate of the visits")
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--causal", action="store_true", help="every model on the turn without the backward pass, too")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder, seeds = args.keep or Path(temporary), range(args.first, args.first + args.seeds)
        for part in args.only:
            if part == "visits":
                visits(folder, seeds, ("smooth=true", "smooth=false") if args.causal else ("smooth=true",), args.fps)
            else:
                globals()[part](folder, seeds)


def rendered(folder: Path, write: Callable[[Path], None]) -> Path:
    """The scene in a folder, written where it is not there yet."""
    if not (folder / "truth.csv").is_file():
        write(folder)
    return folder


def run(scene: Path, *options: str, video: bool = False) -> tuple[dict[str, Any], dict[str, Any], float]:
    """tracks.json and run.json of a run, and its CPU seconds."""
    with tempfile.TemporaryDirectory() as out:
        command = [
            sys.executable,
            "-m",
            "visfuse_cli",
            "-q",
            "track-imm",
            str(scene),
            "--out",
            out + "/run",
            "--no-report",
        ]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*command, *options, *([] if video else ["--no-video"])], check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        documents = [json.loads((Path(out) / "run" / name).read_text()) for name in ("tracks.json", "run.json")]
    return documents[0], documents[1], after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def wheels(scene: Path, *options: str, **rest: Any) -> tuple[dict[str, Any], dict[str, Any], float]:
    return run(scene, "--set", "odometry.wheel_separation=0.4", *options, **rest)


def without_init(scene: Path, folder: Path) -> Path:
    """The same scene without init.yaml, by links."""
    folder.mkdir(parents=True, exist_ok=True)
    for entry in scene.iterdir():
        link = folder / entry.name
        if entry.name != "init.yaml" and not link.exists():
            link.symlink_to(entry.resolve())
    return folder


def truth(scene: Path) -> dict[int, dict[int, Array]]:
    """By target and frame: x, y, z, vx, vy, vz (6,); what is empty is NaN."""
    found: dict[int, dict[int, Array]] = {}
    with open(scene / "truth.csv", newline="") as file:
        for row in csv.DictReader(file):
            values = np.array([float(row[k] or "nan") for k in ("x", "y", "z", "vx", "vy", "vz")])
            found.setdefault(int(row["id"]), {})[int(row["frame"])] = values
    return found


def errors(track: dict[str, Any], true: dict[int, Array], size: int) -> tuple[list[int], Array, Array]:
    """Frames, errors (n, 2 size) and true states (n, 6) of one track against one target."""
    states = [s for s in track["states"] if s["frame"] in true]
    at = np.array([true[s["frame"]] for s in states]).reshape(-1, 6)
    off = np.array([[*s["position"], *s["velocity"]] for s in states]).reshape(-1, 2 * size)
    return [s["frame"] for s in states], off - at[:, [*range(size), *range(3, 3 + size)]], at


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(values**2, axis=-1)))) if len(values) else float("nan")


def turning(true: dict[int, Array], frames: list[int], fps: float) -> NDArray[np.bool_]:
    """Whether the target's course turns at those frames."""
    every = sorted(true)
    course = np.unwrap([np.arctan2(true[k][5], true[k][3]) for k in every])
    rate = dict(zip(every, np.abs(np.gradient(course) * fps), strict=True))
    return np.array([rate[k] > TURNING for k in frames])


def visits(folder: Path, seeds: range, modes: tuple[str, ...], fps: int) -> None:
    print(f"\n{'visit':<7} {'':<5} {'tracks':>6} {'frames':>8} {'RMSE m':>7} {'% range':>8} {'speed m/s':>9}")
    turns: dict[str, list[Array]] = {name + mode: [] for name in MODELS for mode in modes}
    worst = np.zeros(2)
    for seed in seeds:
        place = f"visit{seed}" if fps == 15 else f"visit{seed}at{fps}"
        scene = rendered(folder / place, lambda out, seed=seed: write_head(at_rate(visit(seed), fps), out, init=True))
        true = truth(scene)[1]
        for name, where in (("init", scene), ("bare", without_init(scene, folder / f"{place}-bare"))):
            tracks = wheels(where)[0]["tracks"]
            best = max(tracks, key=lambda t: len(t["states"]), default={"states": []})
            frames, off, at = errors(best, true, 3)
            share = 100 * np.sqrt(np.mean(np.sum(off[:, :3] ** 2, 1) / np.sum(at[:, :3] ** 2, 1)))
            speed = rms(off[:, 3:])
            worst = np.maximum(worst, [share, speed])
            row = f"{len(tracks):6d} {len(frames):4d}/{len(true):<3d} {rms(off[:, :3]):7.3f} {share:8.2f} {speed:9.3f}"
            print(f"{seed:<7} {name:<5} {row}", flush=True)
        for name in MODELS:
            for mode in modes:
                tracks = wheels(scene, "--set", f"filter.kind={name}", "--set", mode)[0]["tracks"]
                if tracks:
                    frames, off, _ = errors(tracks[0], true, 3)
                    turns[name + mode].append(off[turning(true, frames, fps), :3])
    print(f"worst: {worst[0]:.2f} % of the range, {worst[1]:.3f} m/s")
    for mode in modes:
        values = {name: rms(np.concatenate(turns[name + mode])) for name in MODELS}
        print(f"on the turn, {mode}, RMS m: " + ", ".join(f"{name} {value:.4f}" for name, value in values.items()))


def at_rate(scene: HeadScene, fps: int) -> HeadScene:
    return replace(scene, fps=Fraction(fps), n_frames=int(scene.n_frames * fps / float(scene.fps)))


def crossings(folder: Path, seeds: range) -> None:
    print(f"\n{'crossing':<9} {'':<5} {'tracks':>6} {'exchanged':>9} {'RMSE m':>7} {'speed m/s':>9}")
    for seed in seeds:
        scene = rendered(folder / f"two{seed}", lambda out, seed=seed: write_head(room(seed, people=2), out, init=True))
        true = truth(scene)
        for name, where in (("init", scene), ("bare", without_init(scene, folder / f"two{seed}-bare"))):
            tracks = wheels(where)[0]["tracks"]
            exchanged, off = 0, []
            for track in tracks:
                nearest = [
                    min(
                        (rms(np.array([s["position"] - t[s["frame"]][:3]])), k)
                        for k, t in true.items()
                        if s["frame"] in t
                    )
                    for s in track["states"]
                    if any(s["frame"] in t for t in true.values())
                ]
                owners = [k for _, k in nearest]
                exchanged += int(len(owners) > 0 and owners[0] != owners[-1])
                off.append(errors(track, true[max(set(owners), key=owners.count)], 3)[1])
            every = np.concatenate(off) if off else np.zeros((0, 6))
            print(
                f"{seed:<9} {name:<5} {len(tracks):6d} {exchanged:9d} {rms(every[:, :3]):7.3f} {rms(every[:, 3:]):9.3f}"
            )


# Size px, frames/s, baseline m, mean speed and swing m/s, turning rate and swing rad/s with its period s.
CAMERAS = (
    ((256, 220), 15, 0.18, (0.2, 0.08), (0.02, 0.1, 4.0)),
    ((320, 240), 30, 0.10, (0.3, 0.1), (0.0, 0.15, 3.0)),
    ((640, 480), 10, 0.30, (0.2, 0.08), (-0.03, 0.1, 4.0)),
    ((256, 220), 5, 0.18, (0.2, 0.08), (0.02, 0.08, 4.0)),
    ((256, 220), 15, 0.20, (0.5, 0.2), (0.2, 0.25, 3.0)),
)


def still(folder: Path, seeds: range) -> None:
    print("\nstill rooms")
    for seed in seeds:
        size, fps, baseline, speed, turn = CAMERAS[seed % len(CAMERAS)]
        head = replace(room(seed, still=True, seconds=5.0, size=size), baseline=baseline, speed=speed, turn=turn)
        scene = rendered(folder / f"still{seed}", lambda out, head=head, fps=fps: write_head(at_rate(head, fps), out))
        print(f"{seed}: {size[0]}x{size[1]}, {fps} frames/s: {len(wheels(scene)[0]['tracks'])} targets", flush=True)


def street(folder: Path, seeds: range) -> None:
    if not STREET.is_dir():
        print("\nstreet: the recordings lie beside the project; they are not here")
        return
    options = ("--config", "street", "--set", "video.fps=10")
    (track,) = run(STREET, *options)[0]["tracks"]
    places = np.array([s["position"] for s in track["states"]])
    speed = float(np.median([s["speed"] for s in track["states"]]))
    spread = float(np.linalg.norm(places - np.median(places, axis=0), axis=1).max())
    seen = sum(s["measured"] for s in track["states"])
    print(f"\nstreet: parked car measured in {seen} frames, median {speed:.2f} m/s, within {spread:.2f} m of one place")
    bare = run(without_init(STREET, folder / "street-bare"), *options)[0]["tracks"]
    print(f"street without init.yaml: {len(bare)} targets")


def surveyed(folder: Path, scene: GazeScene, angle_noise: float) -> Path:
    """A rendered pan-tilt scene with its homography."""
    rendered(folder, lambda out: write_gaze(scene, out, angle_noise=angle_noise))
    if not (folder / "homography.json").is_file():
        survey = ["calibrate-homography", "--gaze", str(folder / "gaze.csv"), "--out", str(folder / "homography.json")]
        subprocess.run([sys.executable, "-m", "visfuse_cli", "-q", *survey], check=True)
    return folder


def gaze(folder: Path, seeds: range) -> None:
    print(f"\n{'pan-tilt':<9} {'tracks':>6} {'frames':>8} {'RMSE m':>7} {'% range':>8} {'2D mrad':>8} {'3D mrad':>8}")
    for seed in seeds[:5]:
        scene = surveyed(folder / f"gaze{seed}", yard(seed), 2e-4)
        tracks, document, _ = run(scene, "--config", "pan-tilt", "--set", "target.height=0.85")
        head, true = np.array(document["head"]["position"]), truth(scene)[1]
        best = max(tracks["tracks"], key=lambda t: len(t["states"]))
        frames, off, at = errors(best, true, 2)
        far = np.hypot(*(at[:, :2] - head[:2]).T)
        share = 100 * np.sqrt(np.mean(np.sum(off[:, :2] ** 2, 1) / far**2))
        plane, ground = (1e3 * best["summary"][f"prediction_rms_{kind}"] for kind in ("2d", "3d"))
        row = f"{len(tracks['tracks']):6d} {len(frames):4d}/{len(true):<3d} {rms(off[:, :2]):7.3f} {share:8.2f}"
        print(f"{seed:<9} {row} {plane:8.2f} {ground:8.2f}", flush=True)


def meeting(folder: Path, seeds: range) -> None:
    """Three people who meet before a pan-tilt head: each track's owners, and its error against the first."""
    print(f"\n{'meeting':<9} {'tracks':>6}  of whom, frames, RMSE m")
    for seed in seeds[:5]:
        scene = surveyed(folder / f"three{seed}", three(seed), 0.0)
        tracks, true = run(scene, "--config", "pan-tilt", "--set", "target.height=0.85")[0]["tracks"], truth(scene)
        told = []
        for track in tracks:
            near = [
                min((float(np.hypot(*(np.array(s["position"]) - t[s["frame"]][:2]))), k) for k, t in true.items())
                for s in track["states"]
                if all(s["frame"] in t for t in true.values())
            ]
            owners = [k for _, k in near]
            first = max(set(owners), key=owners.count)
            off = errors(track, true[first], 2)[1][:, :2]
            told.append(f"{first} ({owners.count(first)}/{len(owners)}, {rms(off):.2f})")
        print(f"{seed:<9} {len(tracks):6d}  " + ", ".join(told), flush=True)


def speed(folder: Path, seeds: range) -> None:
    print(f"\n{'CPU ms a pair, video written':<40} {'all':>6} {'goal on two cores':>18}")
    for name, size, method, rate in (("256x220", (256, 220), "horn-schunck", 15), ("320x240", (320, 240), "dis", 30)):
        scene = rendered(folder / f"speed{name}", lambda out, size=size: write_head(visit(1, size=size), out))
        start = wheels(scene, "--end", "0.2", "--set", f"flow.method={method}")
        whole = wheels(scene, "--set", f"flow.method={method}", video=True)
        pairs = whole[1]["counts"]["frames"] - start[1]["counts"]["frames"]
        print(f"{name + ' ' + method:<40} {1e3 * (whole[2] - start[2]) / pairs:6.1f} {2e3 / rate:18.1f}")


def memory(folder: Path, seeds: range) -> None:
    """Peak memory of the whole command, video and report written, on one clip and on 10 and 40 times its frames."""
    print("\nmemory, MB")
    for seconds in (4.0, 40.0, 160.0):
        scene = rendered(folder / f"long{seconds:.0f}", lambda out, seconds=seconds: write_head(lap(seconds), out))
        stereo = peak(scene, "--set", "odometry.wheel_separation=0.4")
        ground = surveyed(folder / f"gazelong{seconds:.0f}", watched(seconds), 0.0)
        pan_tilt = peak(ground, "--config", "pan-tilt", "--set", "target.height=0.85")
        print(f"{round(15 * seconds)} frames: {stereo:.1f} stereo, {pan_tilt:.1f} pan-tilt", flush=True)


def peak(scene: Path, *options: str) -> float:
    """MB that a run takes at most."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "visfuse_cli", "-q", "track-imm", str(scene), "--out", out + "/run", *options]
        code = "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True)\n"
        code += "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
        done = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True, check=True)
    return int(done.stdout) / 1024


def lap(seconds: float) -> HeadScene:
    """Somebody who walks to and fro before a head that turns to and fro."""
    scene = room(3, still=True, seconds=seconds)
    return replace(scene, walks=(strolling(seconds, 4.5),), speed=(0.0, 0.05), turn=(0.0, 0.05, 4.0))


def watched(seconds: float) -> GazeScene:
    """Somebody who walks to and fro before a pan-tilt head that follows, at the frame rate of the stereo head."""
    scene = yard(3, size=(256, 192))
    frames = round(15 * seconds)
    return replace(scene, walks=(strolling(seconds, 9.0),), fps=Fraction(15), n_frames=frames)


def strolling(seconds: float, away: float) -> Walk:
    """A walk to and fro, `away` m off."""
    t = np.arange(0, seconds + 2, 0.5)
    return Walk(t, np.column_stack([np.sin(0.8 * t), away + 0.3 * np.cos(0.5 * t)]), 30)


if __name__ == "__main__":
    main()
