"""`speed` on rendered traffic through the real command, against the renderer's truth."""

import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from benchmarks import arterial
from samples.files import write_scene
from samples.road import KINDS
from samples.score import heading_errors, matches, rows

DATA = Path(__file__).parents[2] / "shared" / "data"


def visfuse(*args):
    done = subprocess.run([sys.executable, "-m", "visfuse_cli", *map(str, args)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo") / "out"
    visfuse("demo", "--out", out)
    return out


def test_shipped_sample_is_measured(demo):
    truth = Path(__file__).parents[1] / "visfuse_cli" / "apps" / "sample" / "truth.csv"
    found = matches(demo / "run", truth)
    good = [(abs(float(row["speed_kmh"]) - true)) for row, true, share, _ in found if share > 0.3]
    assert len(good) >= 3
    assert np.mean(good) < 1.6
    assert len({vehicle for *_, vehicle in found}) == len(found)  # nobody twice


def test_annotated_video_has_the_footages_times(demo):
    import av

    with av.open(str(demo / "run" / "annotated.mp4")) as video:
        stamps = [float(frame.pts * frame.time_base) for frame in video.decode(video=0)]
        assert video.streams.video[0].codec_context.pix_fmt == "yuv420p"
    assert len(stamps) == 250
    np.testing.assert_allclose(np.diff(stamps), 0.04, atol=1e-4)


@pytest.fixture(scope="module", params=[("free-flow", 4, 8), ("dense", 3, 10), ("junction", 0, 9)], ids=lambda p: p[0])
def traffic(request, tmp_path_factory):
    """A rendered scene and the run of it."""
    kind, seed, seconds = request.param
    scene = tmp_path_factory.mktemp(kind)
    write_scene(KINDS[kind](seed, seconds, (960, 540)), scene)
    visfuse("calibrate-homography", "--points", scene / "points.csv", "--out", scene / "H.json")
    run = scene / "run"
    visfuse("speed", scene / "clip.mp4", "--homography", scene / "H.json", "--out", run, "--no-video", "--no-report")
    return kind, scene / "truth.csv", run


def test_rendered_traffic_is_found_once_at_its_speed(traffic):
    kind, truth, run = traffic
    frames = Counter(row["id"] for row in rows(truth))
    there = sum(count >= 50 for count in frames.values())
    found = matches(run, truth)
    kept = [(row, true, vehicle) for row, true, share, vehicle in found if share >= 0.5]
    errors = [abs(float(row["speed_kmh"]) - true) for row, true, _ in kept]
    assert len({vehicle for *_, vehicle in kept}) >= 0.75 * there
    assert sum(share < 1 / 3 for *_, share, _ in found) <= 0.15 * len(found)
    assert np.mean(errors) < {"free-flow": 0.8, "dense": 2.0, "junction": 1.5}[kind]
    assert max(errors) < {"free-flow": 3.0, "dense": 5.0, "junction": 3.0}[kind]  # a truck cut off by the edge may err


def test_headings_follow_the_turns(traffic):
    kind, truth, run = traffic
    errors = heading_errors(run, truth)
    assert len(errors) > 200
    assert np.sqrt(np.mean(np.square(errors))) < 10, kind


@pytest.mark.skipif(not (DATA / "speed-arterial").is_dir(), reason="the recorded footage is not here")
def test_city_arterial_runs_at_plausible_speeds(tmp_path):
    source = DATA / "speed-arterial"
    visfuse(
        "calibrate-homography",
        "--points",
        source / "points.csv",
        "--image",
        source / "clip.mp4",
        "--out",
        tmp_path / "H.json",
    )
    visfuse(
        "speed",
        source / "clip.mp4",
        "--homography",
        tmp_path / "H.json",
        "--out",
        tmp_path / "run",
        "--no-video",
        "--end",
        "12",
    )
    away = [row for row in rows(tmp_path / "run" / "speeds.csv") if 60 < float(row["direction"]) < 120]
    assert len(away) >= 6
    free = [float(row["speed_kmh"]) for row in away if float(row["speed_kmh"]) > 30]
    assert 35 < np.median(free) < 60
    timed = [(by_eye, ours) for first, _, by_eye, _, ours in arterial.compared(tmp_path / "run") if first < 280]
    assert len(timed) == 6
    assert all(abs(ours / by_eye - 1) < (0.06 if by_eye < 50 else 0.08) for by_eye, ours in timed), timed
