"""`track-stereo-pf` on rendered passes: `python benchmarks/stereo.py [straight noise unaided curved rivals ...]`.

`--seeds N` passes each (20). Errors are of the summary speed, in miles an hour; `particles` and `parts` are Zhu 2012's
tables I and II with the causal filter, as the paper has it.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import choice
from samples.passing import MPH, PassScene, straight_pass, write_pass
from visfuse_cli.commands.track_stereo_pf import run
from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.records import RunRequest
from visfuse_cli.vision import patches

UNAIDED = {"init": False, "path": False}
MEASURED = "import resource, sys; from visfuse_cli.cli import main; sys.argv[0] = 'visfuse'\ntry: main()\nfinally: "
MEASURED += "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr)"
_scenes = tempfile.TemporaryDirectory()


def main() -> None:
    tables: dict[str, Callable[[int], None]] = {
        "straight": lambda n: passes("straight passes", n),
        "noise": noises,
        "unaided": lambda n: passes("nothing named", n, **UNAIDED),
        "curved": lambda n: passes("curved passes, 36 mph", n, radius=52.0, mph=36.0),
        "rivals": rivals,
        "particles": particles,
        "parts": parts,
        "memory": lambda n: memory(),
        "speed": lambda n: speed(),
    }
    choice.run(__doc__, tables, "--seeds", 20)


def noises(seeds: int) -> None:
    """Three levels of image noise."""
    for level in (1.0, 2.0, 4.0):
        passes(f"image noise {level:g}", seeds, noise=level)


def passes(title: str, seeds: int, settings: dict | None = None, **scene) -> None:
    """One line: errors (mph), intervals that hold the truth, runs without a frame after the third off by 1 mph."""
    files = {key: scene.pop(key) for key in ("init", "path") if key in scene}
    errors, speeds, spent, held, steady = [], [], [], 0, 0
    for seed in range(seeds):
        made = straight_pass(seed, **scene)
        with tempfile.TemporaryDirectory() as folder:
            track = longest(rendered(made, **files), Path(folder) / "run", settings or {}, seed)
            document = json.loads((Path(folder) / "run" / "run.json").read_text(encoding="utf-8"))
            spent.append(1e3 * document["seconds_per_stage"]["filter"] / document["counts"]["pairs"])
        if track is None:
            continue
        truth = made.passes[0].speed
        low, high = track["summary"]["speed_ci95"]
        errors.append((track["summary"]["speed"] - truth) / MPH)
        held += low <= truth <= high
        off_frames = np.array([state["speed"] - truth for state in track["states"][3:]]) / MPH
        speeds.append((truth / MPH + off_frames.mean(), np.abs(off_frames).max()))
        steady += bool(speeds[-1][1] < 1)
    off = np.abs(errors)
    mean, most = np.mean(speeds, axis=0)
    worst = max(each[1] for each in speeds)
    print(
        f"{title:<34} {len(errors)} of {seeds} found, mean error {off.mean():.3f}, worst {off.max():.3f}, "
        f"{np.count_nonzero(off < 0.33)} below 0.33, {held} intervals hold, {steady} steady; "
        f"frames after the third: mean {mean:.2f}, worst {most:.2f} in the mean of the runs, {worst:.2f} of all; "
        f"filter {min(spent):.1f} ms a pair",
        flush=True,
    )


def rendered(made: PassScene, **files: bool) -> Path:
    """The scene's folder, rendered when it is first asked for."""
    name = hashlib.sha256(repr((made, sorted(files.items()))).encode()).hexdigest()[:16]
    folder = Path(_scenes.name) / name
    if not folder.exists():
        write_pass(made, folder, **files)
    return folder


def longest(scene: Path, out: Path, settings: dict, seed: int) -> dict | None:
    """The longest track of a run on a scene."""
    config = StereoConfig.model_validate(settings)
    request = RunRequest("track-stereo-pf", scene, out, config, video=False, report=False, seed=seed)
    run(RunRequest(**{name: getattr(request, name) for name in request.__slots__} | {"progress": False}))
    tracks = json.loads((out / "tracks.json").read_text(encoding="utf-8"))["tracks"]
    return max(tracks, key=lambda track: len(track["states"]), default=None)


def rivals(seeds: int) -> None:
    """The backward pass beside the causal filter, the unconstrained filter, and triangulation with a Kalman filter."""
    causal = {"smooth": False}
    passes("backward pass", seeds)
    passes("causal, along the path", seeds, causal)
    passes("causal, six degrees of freedom", seeds, causal | {"filter": {"path_constraint": False}})
    passes("causal, triangulated and Kalman", seeds, causal | {"filter": {"kind": "triangulation"}})
    passes("smoothed, triangulated and Kalman", seeds, {"filter": {"kind": "triangulation"}})


def particles(seeds: int) -> None:
    """Numbers of particles and noises of the speed, 55 mph. Paper: 200 particles, worst error 0.33 mph."""
    for count in (100, 200, 400, 600, 800):
        settings = {"smooth": False, "filter": {"particles": count, "sigma_v": 0.05}}
        passes(f"{count} particles, noise 0.05", seeds, settings, mph=55.0)
    for noise in (0.05, 0.10, 0.15, 0.20, 0.25):
        settings = {"smooth": False, "filter": {"particles": 400, "sigma_v": noise}}
        passes(f"400 particles, noise {noise:.2f}", seeds, settings, mph=55.0)


def parts(seeds: int) -> None:
    """Numbers of parts of the patch, 400 particles, 55 mph."""
    for count in (4, 7, 10, 13, 16):
        settings = {"smooth": False, "filter": {"sigma_v": 0.05}, "observation": {"parts": count}}
        passes(f"{count} parts, 400 particles", seeds, settings, mph=55.0)


def memory() -> None:
    """Peak memory of whole runs with 400 to 40,000 particles: poses are observed in chunks."""
    for count in (400, 4000, 40_000):
        with tempfile.TemporaryDirectory() as out:
            scene = rendered(straight_pass(0, mph=55.0))
            options = ["--out", out, "--overwrite", "--no-video", "--no-report", "-q"]
            command = [sys.executable, "-c", MEASURED, "track-stereo-pf", str(scene), *options]
            done = subprocess.run(
                [*command, "--set", f"filter.particles={count}"], capture_output=True, text=True, check=True
            )
        print(f"{count:>6} particles: {int(done.stderr.split()[-1]) / 1024:.0f} MB", flush=True)


def speed() -> None:
    """CPU time of the observation of 400 particles in both 1280x960 views, ours and a loop that warps each."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    views = [cv2.GaussianBlur(rng.integers(0, 255, (960, 1280, 3), np.uint8), (0, 0), 2) for _ in range(2)]
    levels = [patches.pyramid(view) for view in views]
    quads = np.array([[500, 400], [620, 400], [620, 490], [500, 490]]) + rng.normal(0, 1.5, (400, 1, 2))
    reference = patches.part_values(levels[0], quads[:1])[0]

    def ours() -> None:
        patches.observed((levels[0], levels[1]), (quads, quads), reference, patches.PARTS)

    def loop() -> None:
        square = np.array([[0, 0], [40, 0], [40, 40], [0, 40]], np.float32)
        for quad in quads.astype(np.float32):
            warped = [
                cv2.warpPerspective(each[0], cv2.getPerspectiveTransform(quad, square), (40, 40)) for each in levels
            ]
            for picture in warped:
                parts = picture.reshape(2, 20, 5, 8).swapaxes(1, 2).reshape(10, 20, 8)
                np.concatenate([cv2.resize(part, (4, 4), interpolation=cv2.INTER_AREA).ravel() for part in parts])
            np.corrcoef(warped[0].ravel(), warped[1].ravel())

    pairs = [(cpu(ours), cpu(loop)) for _ in range(7)]
    ratio = float(np.median([slow / quick for quick, slow in pairs]))
    print(
        f"observation of 400 particles {1e3 * np.median([a for a, _ in pairs]):.1f} ms; "
        f"the loop takes {ratio:.1f} times as long"
    )


def cpu(work: Callable[[], None]) -> float:
    begun = time.process_time()
    work()
    return time.process_time() - begun


if __name__ == "__main__":
    main()
