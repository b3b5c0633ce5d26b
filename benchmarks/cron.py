"""Nights of cron in a few minutes: `python benchmarks/cron.py --clips 30 --kills 20`.

Clips arrive piece by piece in random order (lanes that are found need --in-order: the first clip to show enough
vehicles finds them for all) while `speed --new-only` runs overlap and are killed (SIGKILL) at random
instants. In the end the log's export, and every clip's own results, must equal those of one run over all clips that
nobody disturbed, byte for byte.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from samples.files import write_clip, write_scene
from samples.render import frames
from samples.road import free_flow

VISFUSE = (sys.executable, "-m", "visfuse_cli")
SIZE, CLIP_S, STEP_S = (480, 270), 4.0, 0.6  # each clip shows a stretch of one road of its own
CLOCK = ("--set", "clock.pattern=cam_%Y%m%d-%H%M%S", "--set", "clock.zone=Europe/Vienna")
OPTIONS = ("--new-only", "--no-video", "-q", *CLOCK)
COMPARED = ("tracks.json", "speeds.csv", "rejected.csv")
BEFORE = 3600  # s: how old a file is made that has arrived whole


def visfuse(*args: object, code: int = 0) -> str:
    """Run to the end; anything but the expected exit code ends the rehearsal."""
    done = subprocess.run([*VISFUSE, *map(str, args)], capture_output=True, text=True)
    if done.returncode != code:
        sys.exit(f"visfuse {args[0]} ended with {done.returncode}: {done.stderr}")
    return done.stdout


def make_clips(folder: Path, count: int) -> Path:
    """Write the homography and `count` clips named by the night in which clocks are put back; returns H.json."""
    scene = free_flow(5, CLIP_S + STEP_S * count, size=SIZE)
    (folder / "clips").mkdir(parents=True)
    few = free_flow(5, 0.2, size=SIZE)
    write_scene(few, folder / "scene")
    homography = folder / "H.json"
    visfuse("calibrate-homography", "--points", folder / "scene" / "points.csv", "--out", homography, "-q")
    pictures = list(frames(scene))
    for number in range(count):
        first = round(number * STEP_S * float(scene.fps))
        window = pictures[first : first + round(CLIP_S * float(scene.fps))]
        name = time.strftime("cam_%Y%m%d-%H%M%S.mp4", time.gmtime(1_792_886_400 + 420 * number))
        write_clip(folder / "clips" / name, window, SIZE, scene.fps, 23)
    return homography


def arrive(source: Path, target: Path, order: list[str], rng: random.Random, span_s: float) -> None:
    """Copy clips one by one, each in two pieces, spread over `span_s` seconds."""
    target.mkdir()
    for name in order:
        data = (source / name).read_bytes()
        with open(target / name, "wb") as file:
            file.write(data[: len(data) // 2])
            file.flush()
            time.sleep(rng.uniform(0.1, 0.9) * span_s / len(order))
            file.write(data[len(data) // 2 :])
        os.utime(target / name, (time.time() - BEFORE,) * 2)


class Night:
    """Overlapping runs over a folder in which clips arrive, and what became of them."""

    def __init__(self, command: list[str], rng: random.Random) -> None:
        self.command, self.rng = command, rng
        self.running: list[subprocess.Popen[str]] = []
        self.codes: Counter[int] = Counter()
        self.silent = True

    def start(self) -> None:
        self.running.append(subprocess.Popen(self.command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))

    def kill(self) -> bool:
        """Kill the run that began first: it is the one at work."""
        if not self.running:
            return False
        self.running[0].kill()
        return True

    def collect(self) -> None:
        """Note how runs have ended; success must have been silent."""
        for run in [run for run in self.running if run.poll() is not None]:
            self.running.remove(run)
            output = "".join(run.communicate())
            self.codes[run.returncode] += 1
            self.silent &= run.returncode != 0 or output == ""
            if run.returncode not in (0, 75, -9):
                sys.exit(f"a run ended with {run.returncode}: {output}")

    def rehearse(self, kills: int, arriving: threading.Thread) -> int:
        """Overlapping runs until all has arrived and every kill is done; then undisturbed ones; returns the kills."""
        killed, next_kill, next_start = 0, time.monotonic() + 3, 0.0
        while killed < kills or arriving.is_alive():
            now = time.monotonic()
            if now >= next_start and len(self.running) < 3:
                self.start()
                next_start = now + self.rng.uniform(0.3, 3)
            if now >= next_kill and killed < kills:
                killed += self.kill()
                next_kill = now + self.rng.uniform(0.5, 14)
            time.sleep(0.02)
            self.collect()
        while self.running:
            time.sleep(0.1)
            self.collect()
        return killed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=30)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--in-order", action="store_true", help="clips arrive in the order of their names")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the speed command")
    parser.add_argument("--keep", type=Path, help="folder for all of it, instead of a temporary one")
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.keep or Path(temporary)
        homography = make_clips(folder, arguments.clips)
        order = sorted(path.name for path in (folder / "clips").iterdir())
        if not arguments.in_order:
            rng.shuffle(order)
        span_s = 6.0 * arguments.kills
        arriving = threading.Thread(target=arrive, args=(folder / "clips", folder / "in", order, rng, span_s))
        arriving.start()
        time.sleep(0.1)
        settings = [part for each in arguments.set for part in ("--set", each)]
        common = ("--homography", homography, *OPTIONS, *settings)
        command = ["speed", folder / "in", *common, "--log", folder / "night.sqlite", "--out", folder / "night"]
        night = Night([*VISFUSE, *map(str, command)], rng)
        killed = night.rehearse(arguments.kills, arriving)
        arriving.join()
        visfuse(*command)
        again = json.loads(visfuse(*command, "--json"))
        for path in (folder / "clips").iterdir():
            os.utime(path, (time.time() - BEFORE,) * 2)
        clean = ("--log", folder / "clean.sqlite", "--out", folder / "clean")
        visfuse("speed", folder / "clips", *common, *clean)
        report(folder, night, killed, again)


def report(folder: Path, night: Night, killed: int, again: dict[str, int]) -> None:
    """Compare the two logs and the two trees of results, and say so; leaves with 1 where they differ."""
    ended = ", ".join(f"{count} with {code}" for code, count in sorted(night.codes.items()))
    print(f"runs ended: {ended}; {killed} killed; success was {'silent' if night.silent else 'NOT silent'}")
    print(f"a run after the last one takes {again['clips']} clips")
    same = []
    for form in ("csv", "json"):
        exports = [visfuse("export", folder / f"{name}.sqlite", "--format", form) for name in ("night", "clean")]
        same.append(exports[0] == exports[1])
        print(f"export as {form}: {len(exports[1])} bytes, {'equal' if same[-1] else 'DIFFERENT'}")
    summaries = [visfuse("summary", folder / f"{name}.sqlite", "--by", "hour") for name in ("night", "clean")]
    same.append(summaries[0] == summaries[1])
    trees = [sorted(path.name for path in (folder / name).iterdir()) for name in ("night", "clean")]
    files = [(clip, name) for clip in trees[1] for name in COMPARED]
    equal = [(folder / "night" / c / n).read_bytes() == (folder / "clean" / c / n).read_bytes() for c, n in files]
    left = list((folder / "night").rglob(".*"))
    print(f"summary {'equal' if same[-1] else 'DIFFERENT'}; {sum(equal)} of {len(files)} result files equal")
    print(f"left over in the results: {', '.join(map(str, left)) or 'nothing'}")
    print(summaries[1])
    if not (all(same) and all(equal) and np.equal(*trees).all() and not left and night.silent and not again["clips"]):
        sys.exit(1)


if __name__ == "__main__":
    main()
