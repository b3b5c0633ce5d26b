"""A batch of 24 scenes on one worker and on two, one thread each: `python benchmarks/batch.py --scenes DIR`.

Scenes of every command are rendered into DIR, once. Then the whole batch runs on one worker and on two in turn; the
times from the first item's begin to the last one's end are compared. In the last run one
worker is killed in mid-item: nothing may be lost, nothing done twice, and no result may differ in a byte.
"""

from __future__ import annotations

import argparse
import csv
import os
import resource
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from fractions import Fraction
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from samples.files import write_scene
from samples.head import room, write_head
from samples.passing import straight_pass, write_pass
from samples.people import crossing
from samples.road import free_flow
from samples.yard import write_yard

VISFUSE = (sys.executable, "-m", "visfuse_cli")
EACH = 6  # scenes of a command; the roads' own calibrations run in the batch as well
MANIFEST = """
defaults: {END}
items:
  - {command: speed, input: roads/*/clip.mp4, homography: "{parent}/H.json"}
  - {command: track-imm, input: rooms/*, set: {odometry.wheel_separation: 0.4}}
  - {command: track-stereo-pf, input: passes/*}
  - {command: fuse-cameras, input: yards/*}
"""
DONE = "batch.json"
KILL_AFTER = 6  # items
COMPARED = ("tracks.json", "speeds.csv", "rejected.csv")


def make_scenes(folder: Path) -> None:
    """Render what is not there yet."""
    for number in range(EACH):
        makers = {
            "roads": lambda out, seed=number: write_scene(free_flow(seed, 6, size=(640, 360)), out),
            "rooms": lambda out, seed=number: write_head(room(seed, seconds=3.0), out, init=True),
            "passes": lambda out, seed=number: write_pass(straight_pass(seed), out),
            "yards": lambda out, seed=number: write_yard(
                crossing(seed, seconds=5.0, people=2, size=(480, 360), fps=Fraction(15)), out
            ),
        }
        for kind, make in makers.items():
            out = folder / kind / f"{number}"
            if not (out / "done").exists():
                make(out)
                (out / "done").touch()
        road = folder / "roads" / f"{number}"
        if not (road / "H.json").exists():
            command = ("calibrate-homography", "--points", road / "points.csv", "--size", "640x360", "--out")
            subprocess.run([*VISFUSE, *map(str, command), road / "H.json", "-q"], check=True)


def run(folder: Path, out: Path, workers: int, kill: bool = False) -> tuple[float, float]:
    """Run the batch; returns wall seconds from the first item's begin to the last one's end, and CPU seconds of all."""
    used = _cpu()
    command = [*VISFUSE, "batch", folder / "manifest.yaml", "--out", out, "--workers", str(workers), "--threads", "1"]
    batch = subprocess.Popen([*map(str, command), "-q"])
    if kill:
        newest = None
        while newest is None or len(list(out.glob("*/batch.json"))) < KILL_AFTER or (newest.parent / DONE).exists():
            time.sleep(0.1)
            newest = max(out.glob("*/batch.log"), key=lambda log: log.stat().st_mtime, default=None)
        victim = newest.read_text().split("process ")[-1].split(":")[0]
        os.kill(int(victim), signal.SIGKILL)
        print(f"killed process {victim} at {newest.parent.name}")
    if batch.wait() != 0:
        sys.exit(f"the batch ended with {batch.returncode}")
    logs = list(out.glob("*/batch.log"))
    begun = min(log.stat().st_ctime - float(row["seconds"]) for log in logs for row in [_row(out, log.parent.name)])
    return max((log.parent / DONE).stat().st_mtime for log in logs) - begun, _cpu() - used


def _cpu() -> float:
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def _row(out: Path, name: str) -> dict[str, str]:
    with open(out / "results.csv", newline="") as file:
        return next(row for row in csv.DictReader(file) if row["name"] == name)


def same(one: Path, other: Path) -> int:
    """How many result files two runs have in common, byte for byte; leaves where any differs."""
    files = [path.relative_to(one) for name in COMPARED for path in one.glob(f"*/{name}")]
    different = [path for path in files if (one / path).read_bytes() != (other / path).read_bytes()]
    if different:
        sys.exit(f"different: {', '.join(map(str, different))}")
    return len(files)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True, help="folder of the scenes, made where it is not")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--end", type=float, help="s of each scene, without videos and reports; default: all of it")
    arguments = parser.parse_args()
    make_scenes(arguments.scenes)
    short = "" if arguments.end is None else f"end: {arguments.end}, video: false, report: false"
    (arguments.scenes / "manifest.yaml").write_text(MANIFEST.replace("END", short))
    ratios = []
    with tempfile.TemporaryDirectory() as temporary:
        for number in range(arguments.rounds):
            one, two = (run(arguments.scenes, Path(temporary) / f"{number}-{n}", n) for n in (1, 2))
            ratios.append(one[0] / two[0])
            for name, (wall, cpu) in (("one worker", one), ("two workers", two)):
                print(f"{name}: {wall:.1f} s, {cpu:.1f} s of CPU, load {os.getloadavg()[0]:.1f}", flush=True)
            print(f"ratio {one[0] / two[0]:.2f}", flush=True)
        killed = Path(temporary) / "killed"
        run(arguments.scenes, killed, 2, kill=True)
        begins = [log.read_text().count(" process ") for log in killed.glob("*/batch.log")]
        print(f"{len(begins)} items, begun {sum(begins)} times with one worker killed")
        print(f"{same(Path(temporary) / '0-1', killed)} result files equal")
    print(f"median ratio {statistics.median(ratios):.2f} over {len(ratios)} rounds")


if __name__ == "__main__":
    main()
