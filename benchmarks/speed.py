"""How fast and how large `visfuse speed` is beside plain OpenCV, in one run: `python benchmarks/speed.py`.

Both sides run on one thread, in turn; the ratio of each pair is taken and the median printed.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
THREADS = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
os.environ.update(THREADS)

import cv2  # noqa: E402

from samples.files import write_scene  # noqa: E402
from samples.road import free_flow  # noqa: E402
from visfuse_cli.files.video import open_source  # noqa: E402
from visfuse_cli.files.video_writer import VideoWriter  # noqa: E402
from visfuse_cli.vision.background import Background  # noqa: E402

PAIRS = 5
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


def seconds(work: Callable[[], object]) -> float:
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def compare(name: str, rival: Callable[[], object], ours: Callable[[], object], goal: str) -> None:
    """Print the median times and the median of the paired ratios ours / rival."""
    pairs = [(seconds(rival), seconds(ours)) for _ in range(PAIRS)]
    a, b = (statistics.median(side) for side in zip(*pairs, strict=True))
    ratio = statistics.median(ours_s / rival_s for rival_s, ours_s in pairs)
    print(row(name, "s", a, b, goal, ratio))


def row(name: str, unit: str, rival: float, ours: float, goal: str, ratio: float | None = None) -> str:
    """One line of the table."""
    ratio = ours / rival if ratio is None else ratio
    return f"{name:<42} {rival:>9.2f} {unit:<2} {ours:>9.2f} {unit:<2} {ratio:>7.2f}   {goal}"


def process(*command: str) -> int:
    """Run a command; its peak memory in kB."""
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | THREADS)
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(command)}: failed")
    return usage.ru_maxrss


def decode_cv2(clip: Path) -> list[int]:
    reader, sizes = cv2.VideoCapture(str(clip)), []
    while (read := reader.read())[0]:
        sizes.append(read[1].size)
    return sizes


def decode_ours(clip: Path) -> list[int]:
    with open_source(clip) as source:
        return [frame.image.size for frame in source.frames()]


def main() -> None:
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_scene(free_flow(1, 48), folder)  # 1200 frames of 1280x720
        clip, H = folder / "clip.mp4", folder / "H.json"
        visfuse = (sys.executable, "-m", "visfuse_cli")
        process(*visfuse, "calibrate-homography", "--points", str(folder / "points.csv"), "--out", str(H), "-q")

        def speed(*options: str) -> int:
            out = str(folder / "run")
            return process(
                *visfuse, "speed", str(clip), "--homography", str(H), "--out", out, "--overwrite", "-q", *options
            )

        print(f"{'work (1280x720)':<42} {'rival':>11} {'visfuse':>11} {'ratio':>8}   goal")
        # Before this process grows: a child's peak begins with what its parent held.
        short, long = speed("--no-video", "--end", "12"), speed("--no-video")
        print(row("peak memory, 300 against 1200 frames", "MB", short / 1e3, long / 1e3, "at most 1.05"))

        with open_source(clip, end=8) as source:
            frames = [frame.image for frame in source.frames()]

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

        def write_mp4v() -> None:
            writer = cv2.VideoWriter(
                str(folder / "rival.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25, frames[0].shape[1::-1]
            )
            for frame in frames:
                writer.write(frame)
            writer.release()

        def write_ours() -> None:
            with VideoWriter(folder / "ours.mp4", *frames[0].shape[1::-1]) as writer:
                for number, frame in enumerate(frames):
                    writer.write(frame, number / 25)

        compare("decode to BGR, cv2", lambda: decode_cv2(clip), lambda: decode_ours(clip), "at most 1")
        compare("background, bare MOG2", background_bare, background_ours, "")
        compare("H.264 out, cv2 mp4v", write_mp4v, write_ours, "at most 0.67")
        sizes = [(folder / f"{who}.mp4").stat().st_size for who in ("rival", "ours")]
        print(row("  file size", "MB", sizes[0] / 1e6, sizes[1] / 1e6, "below 1"))

        def bare() -> int:
            return process(sys.executable, "-c", BARE, str(clip))

        compare("whole speed run, decode + bare MOG2", bare, lambda: speed("--no-video"), "at most 2")
        compare("whole speed run with video", bare, speed, "")
        print(f"{'  the footage lasts':<42} {48.0:>9.2f} s")


if __name__ == "__main__":
    main()
