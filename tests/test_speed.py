"""`speed` on rendered traffic through the real command, against the renderer's truth."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from samples.files import write_scene
from samples.road import free_flow
from samples.score import matches, rows

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


def test_free_flow_road(tmp_path):
    write_scene(free_flow(4, 15), tmp_path / "scene")
    scene, run = tmp_path / "scene", tmp_path / "run"
    visfuse(
        "calibrate-homography",
        "--points",
        scene / "points.csv",
        "--image",
        scene / "clip.mp4",
        "--out",
        tmp_path / "H.json",
    )
    visfuse("speed", scene / "clip.mp4", "--homography", tmp_path / "H.json", "--out", run, "--no-video")
    found = matches(run, scene / "truth.csv")
    errors = [abs(float(row["speed_kmh"]) - true) for row, true, share, _ in found if share >= 0.5]
    assert len(errors) >= 9  # of 17
    assert np.mean(errors) < 1.6
    assert max(errors) < 6


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
