"""`visfuse track-imm` before a rendered pan-tilt head: the ground track, prediction, height, bad scenes."""

import csv
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from samples.gaze import write_gaze, yard

pytestmark = pytest.mark.contract
PERSON = ("--set", "target.height=0.85")


def visfuse(*args):
    command = [sys.executable, "-m", "visfuse_cli", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def run(*args):
    return visfuse("track-imm", *args)


def surveyed(scene, out):
    write_gaze(scene, out)
    done = visfuse("calibrate-homography", "--gaze", out / "gaze.csv", "--out", out / "homography.json")
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return surveyed(yard(1, seconds=4.0, size=(256, 192)), tmp_path_factory.mktemp("yard"))


@pytest.fixture(scope="module")
def result(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("result") / "run"
    done = run(scene, "--config", "pan-tilt", *PERSON, "--out", out)
    assert done.returncode == 0, done.stderr
    return out


def document(out):
    return json.loads((out / "tracks.json").read_text(encoding="utf-8"))


def errors(scene, out):
    """Errors (n, 4) of the only track, and its ranges (n,) from the head."""
    with open(scene / "truth.csv", newline="", encoding="utf-8") as file:
        truth = {
            int(row["frame"]): np.array([float(row[k]) for k in ("x", "y", "vx", "vy")]) for row in csv.DictReader(file)
        }
    (track,) = document(out)["tracks"]
    head = json.loads((out / "run.json").read_text(encoding="utf-8"))["head"]["position"]
    states = [s for s in track["states"] if s["frame"] in truth]
    off = np.array([np.array([*s["position"], *s["velocity"]]) - truth[s["frame"]] for s in states])
    return off, np.array([np.hypot(*(truth[s["frame"]][:2] - head[:2])) for s in states])


def test_the_ground_track_is_within_two_per_cent_of_the_range(scene, result):
    off, far = errors(scene, result)
    assert len(off) > 85
    assert np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1) / far**2)) < 0.02
    assert np.sqrt(np.mean(np.sum(off[:, 2:] ** 2, axis=1))) < 0.1
    cov = np.array([state["covariance"] for state in document(result)["tracks"][0]["states"]])[: len(off), :2, :2]
    normalised = np.einsum("ti,ti->t", off[:, :2], np.linalg.solve(cov, off[:, :2, None])[..., 0])
    assert np.median(normalised) < 10  # the box lies off its target for good, and the covariance says so


def test_what_the_contract_promises_is_there(result):
    whole = document(result)
    assert whole["frame_of_reference"] == "ground"
    (track,) = whole["tracks"]
    state = track["states"][40]
    assert len(state["position"]) == len(state["velocity"]) == 2
    assert np.linalg.eigvalsh(np.array(state["covariance"])).min() > 0
    assert set(state["models"]) == {"csd", "cs", "cd"}
    assert sum(state["models"].values()) == pytest.approx(1)
    assert state["ahead"]["t"] == pytest.approx(state["t"] + 0.15)
    assert set(state["box"]) == {"left"}
    for name in ("annotated.mp4", "report.html", "run.json"):
        assert (result / name).stat().st_size > 1000


def test_the_ground_predicts_the_gaze_no_worse_than_the_angles_do(result):
    (track,) = document(result)["tracks"]
    plane, ground = (track["summary"][f"prediction_rms_{kind}"] for kind in ("2d", "3d"))
    assert 0 < ground < 1.1 * plane


def test_a_head_at_rest_works_by_foot_points_and_a_homography_given_aside(tmp_path):
    folder = surveyed(yard(7, seconds=3.0, size=(256, 192), follow=False), tmp_path / "yard")
    (folder / "homography.json").rename(tmp_path / "H.json")
    done = run(folder, "--homography", tmp_path / "H.json", "--out", tmp_path / "run", "--no-video", "--no-report")
    assert done.returncode == 0, done.stderr
    off, far = errors(folder, tmp_path / "run")
    assert np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1) / far**2)) < 0.03


def test_a_height_is_where_the_middle_of_the_box_is(scene, result, tmp_path):
    """The same box said to be at half the height lies where the ray meets that height: further away."""
    out = tmp_path / "run"
    done = run(scene, "--set", "target.height=0.4", "--end", 2, "--out", out, "--no-video", "--no-report")
    assert done.returncode == 0, done.stderr
    head = np.array(json.loads((out / "run.json").read_text(encoding="utf-8"))["head"]["position"])
    low, high = (document(path)["tracks"][0]["states"][20] for path in (out, result))
    away = (np.array(state["position"]) - head[:2] for state in (low, high))
    ratio = np.divide(*(np.linalg.norm(each) for each in away))
    assert ratio == pytest.approx((head[2] - 0.4) / (head[2] - 0.85), rel=0.01)


BAD = {
    "no homography": (lambda f: (f / "homography.json").unlink(), "has no homography"),
    "no lens": (lambda f: (f / "calibration.yaml").write_text("%YAML:1.0\n---\nM1: 3\n"), "calibration.yaml"),
    "two footages": (lambda f: shutil.copy(f / "left.mp4", f / "left.mkv"), "is there twice"),
    "no view": (lambda f: (f / "left.mp4").unlink(), "has no view 'left'"),
    "short angles": (
        lambda f: (f / "sensors.csv").write_text("t,elevation,vergence\n0,0,0\n1,0,0\n"),
        "samples run from t = 0 to 1 s",
    ),
    "broken homography": (lambda f: (f / "homography.json").write_text("{}"), "not a homography"),
    "wheels": (lambda f: (f / "sensors.csv").write_text("t,v1,v2\n0,0,0\n9,0,0\n"), "M2, D2, R, T missing"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_scenes_are_refused_in_one_line(case, scene, tmp_path):
    spoil, fragment = BAD[case]
    folder = tmp_path / "scene"
    shutil.copytree(scene, folder)
    spoil(folder)
    done = run(folder, "--out", tmp_path / "run", "--no-video")
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 3, done.stderr
    assert len(lines) == 1, done.stderr
    assert fragment in lines[0], lines[0]
    assert not (tmp_path / "run" / "tracks.json").exists()
