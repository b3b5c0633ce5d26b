"""How fast and how large `visfuse speed` is beside plain OpenCV, in one run: `python benchmarks/speed.py`.

Parts are compared on one thread each, in turn: the ratio of each pair is taken and the median printed. Whole runs use
the threads that they use for anybody, as the bare ones do, and tell their processor time too, which other work on the
machine changes less than the time on the wall. `--keep DIR` renders the scenes once.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
THREADS = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
os.environ.update(THREADS)

import cv2  # noqa: E402

from samples.files import write_scene  # noqa: E402
from samples.road import KINDS  # noqa: E402
from visfuse_cli.files.video import open_source  # noqa: E402
from visfuse_cli.files.video_writer import VideoWriter  # noqa: E402
from visfuse_cli.vision.background import Background  # noqa: E402

PAIRS = 5
LOOK_S = 0.5  # between looks at the memory, which hold the process up
SEED = {"free-flow": 1, "dense": 0}
VISFUSE = (sys.executable, "-m", "visfuse_cli")
BARE = """
import cv2, sys
cv2.setNumThreads(1)
clip, model = cv2.VideoCapture(sys.argv[1]), cv2.createBackgroundSubtractorMOG2()
while True:
    ok, frame = clip.read()
    if not ok:
        break
    model.apply(frame)
"""


@dataclass(frozen=True)
class Usage:
    """What a process and its children took: s on the wall, s of processor time, peak memory in MB."""

    wall: float
    cpu: float
    peak: float


def seconds(work: Callable[[], object]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def compare(name: str, rival: Callable[[], object], ours: Callable[[], object], goal: str) -> None:
    """Print the median times and the median of the paired ratios ours / rival."""
    pairs = [(seconds(rival), seconds(ours)) for _ in range(PAIRS)]
    print(row(name, "s", pairs, goal))


def row(name: str, unit: str, pairs: list[tuple[float, float]], goal: str) -> str:
    """One line of the table: medians of both sides and of the paired ratios ours / rival."""
    rival, ours = (statistics.median(side) for side in zip(*pairs, strict=True))
    ratio = statistics.median(b / a for a, b in pairs)
    return f"{name:<46} {rival:>9.2f} {unit:<2} {ours:>9.2f} {unit:<2} {ratio:>7.2f}   {goal}"


def process(*command: str) -> Usage:
    """Run a command."""
    begun = time.perf_counter()
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | THREADS)
    peak, ended = 0.0, 0
    while not ended:
        time.sleep(LOOK_S)
        peak = max(peak, _held(child.pid) + sum(_held(int(pid)) for pid in _children(child.pid)))
        ended, status, usage = os.wait4(child.pid, os.WNOHANG)
    if status:
        raise SystemExit(f"{' '.join(command)}: failed")
    return Usage(time.perf_counter() - begun, usage.ru_utime + usage.ru_stime, peak)


def _children(pid: int) -> list[str]:
    with suppress(OSError):
        return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return []


def _held(pid: int) -> float:
    """MB of memory that a process holds; what it shares with another counts half for each. 0 where it has ended."""
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) / 1e3
    return 0.0


def scene(kept: Path, kind: str, length: int) -> Path:
    """The folder of a rendered road of so many seconds and its calibration, made where it is missing."""
    folder = kept / f"{kind}-{length}"
    if not (folder / "H.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_scene(KINDS[kind](SEED[kind], length), folder)
        points, H = str(folder / "points.csv"), str(folder / "H.json")
        process(*VISFUSE, "calibrate-homography", "--points", points, "--out", H, "-q")
    return folder


def speed(folder: Path, *options: str) -> Usage:
    """One run of the command on a scene."""
    H, out = str(folder / "H.json"), str(folder / "run")
    clip = str(folder / "clip.mp4")
    return process(*VISFUSE, "speed", clip, "--homography", H, "--out", out, "--overwrite", "-q", *options)


def memory(kept: Path) -> None:
    """Print the peak memory of runs on short and long footage."""
    clip = scene(kept, "free-flow", 48)
    sides = [(speed(clip, "--no-video", "--end", "12").peak, speed(clip, "--no-video").peak)]
    print(row("peak memory, free flow, 300 and 1200 frames", "MB", sides, "at most 1.05"))
    sides = [(speed(scene(kept, "dense", 15)).peak, speed(scene(kept, "dense", 60)).peak)]
    print(row("peak memory, dense with video, 375 and 1500", "MB", sides, "at most 1.05"))


def parts(kept: Path) -> None:
    """Print how long decoding, background and writing take beside OpenCV."""
    clip = scene(kept, "free-flow", 48) / "clip.mp4"
    with open_source(clip, end=8) as source:
        frames = [frame.image for frame in source.frames()]

    def decode_cv2() -> list[int]:
        reader, sizes = cv2.VideoCapture(str(clip)), []
        while (read := reader.read())[0]:
            sizes.append(read[1].size)
        return sizes

    def decode_ours() -> list[int]:
        with open_source(clip) as source:
            return [frame.image.size for frame in source.frames()]

    def background_bare() -> None:
        model = cv2.createBackgroundSubtractorMOG2()
        for frame in frames:
            model.apply(frame)

    def background_ours() -> None:
        model = Background("mog2", 16.0, 0.45, 60.0)
        model.start(frames[0])
        for number, frame in enumerate(frames):
            model.detect(frame)
            model.learn(frame, number / 25, [])

    compare("decode to BGR, cv2", decode_cv2, decode_ours, "at most 1")
    compare("background, bare MOG2", background_bare, background_ours, "")
    with tempfile.TemporaryDirectory() as name:
        rival, ours = Path(name) / "rival.mp4", Path(name) / "ours.mp4"

        def write_mp4v() -> None:
            writer = cv2.VideoWriter(str(rival), cv2.VideoWriter.fourcc(*"mp4v"), 25, frames[0].shape[1::-1])
            for frame in frames:
                writer.write(frame)
            writer.release()

        def write_ours() -> None:
            with VideoWriter(ours, *frames[0].shape[1::-1]) as writer:
                for number, frame in enumerate(frames):
                    writer.write(frame, number / 25)

        compare("H.264 out, cv2 mp4v", write_mp4v, write_ours, "at most 0.67")
        print(row("  file size", "MB", [(rival.stat().st_size / 1e6, ours.stat().st_size / 1e6)], "below 1"))


def whole(kept: Path) -> None:
    """Print how long whole runs take, beside decoding and bare MOG2 and beside the footage itself."""
    flow, dense = scene(kept, "free-flow", 48), scene(kept, "dense", 15)
    for name, folder, options, goal in (
        ("free flow", flow, ("--no-video",), "at most 2"),
        ("free flow with video", flow, (), ""),
        ("dense with video", dense, (), ""),
    ):
        runs = [
            (process(sys.executable, "-c", BARE, str(folder / "clip.mp4")), speed(folder, *options))
            for _ in range(PAIRS)
        ]
        print(row(f"{name}, decode + bare MOG2", "s", [(bare.wall, ours.wall) for bare, ours in runs], goal))
        print(row("  processor time", "s", [(bare.cpu, ours.cpu) for bare, ours in runs], ""))
    print(row("dense with video, the footage", "s", [(15.0, ours.wall) for _, ours in runs], "below 1"))


# In this order: a child's peak begins with what its parent held, and `parts` holds pictures.
PARTS = {"memory": memory, "whole": whole, "parts": parts}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python benchmarks/speed.py", description=__doc__)
    parser.add_argument("--keep", type=Path, help="folder of the scenes; rendered where they are missing")
    parser.add_argument("--only", nargs="+", choices=tuple(PARTS), default=tuple(PARTS))
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{'work (1280x720)':<46} {'rival':>11} {'visfuse':>11} {'ratio':>8}   goal")
    with tempfile.TemporaryDirectory() as name:
        for part, measure in PARTS.items():
            if part in chosen.only:
                measure(chosen.keep or Path(name))


if __name__ == "__main__":
    main()
