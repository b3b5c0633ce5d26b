"""`visfuse track-stereo-pf` on rendered passes: speeds, positions, several starts, bad scenes."""

import csv
import json
import shutil
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from samples.passing import MPH, straight_pass, write_pass

pytestmark = pytest.mark.contract


def run(*args):
    command = [sys.executable, "-m", "visfuse_cli", "track-stereo-pf", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    out = tmp_path_factory.mktemp("pass")
    write_pass(straight_pass(31, mph=42.0), out)
    return out


@pytest.fixture(scope="module")
def result(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("result") / "run"
    done = run(scene, "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    return out


def tracks(out):
    return json.loads((out / "tracks.json").read_text(encoding="utf-8"))["tracks"]


def truth(scene):
    with open(scene / "truth.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {int(row["frame"]): np.array([float(row[k]) for k in ("x", "y", "z")]) for row in rows}


def test_the_speed_is_right_to_half_a_mile_per_hour_and_its_interval_holds_the_truth(scene, result):
    (track,) = tracks(result)
    error = track["summary"]["speed"] / MPH - 42.0
    assert abs(error) < 0.5
    low, high = track["summary"]["speed_ci95"]
    assert high - low < 2 * MPH
    assert all(abs(state["speed"] / MPH - 42.0) < 1.5 for state in track["states"][3:])


def test_positions_are_those_of_the_fronts_middle(scene, result):
    true = truth(scene)
    (track,) = tracks(result)
    assert len(track["states"]) >= 0.9 * len(true)
    for state in track["states"]:
        off = np.array(state["position"]) - true[state["frame"]][:3]
        assert np.linalg.norm(off) < 0.02 * true[state["frame"]][2]
        cov = np.array(state["covariance"])
        assert np.linalg.eigvalsh(cov).min() > 0
    assert np.linalg.norm(np.array(track["states"][-1]["position"]) - true[track["states"][-1]["frame"]][:3]) < 0.3


def test_what_the_contract_promises_is_there(result):
    document = json.loads((result / "tracks.json").read_text(encoding="utf-8"))
    assert document["frame_of_reference"] == "left-camera"
    assert set(document["tracks"][0]["states"][0]["box"]) == {"left", "right"}
    for name in ("annotated.mp4", "report.html", "run.json"):
        assert (result / name).stat().st_size > 1000


def test_the_same_seed_gives_the_same_bytes(scene, result, tmp_path):
    assert run(scene, "--out", tmp_path / "again", "--no-video", "--no-report").returncode == 0
    assert (tmp_path / "again" / "tracks.json").read_bytes() == (result / "tracks.json").read_bytes()


def test_nobody_needs_to_name_the_vehicle_or_its_path(scene, tmp_path):
    bare = tmp_path / "bare"
    bare.mkdir()
    for name in ("left.mp4", "right.mp4", "calibration.yaml"):
        shutil.copy(scene / name, bare)
    assert run(bare, "--out", tmp_path / "run", "--no-video", "--no-report").returncode == 0
    (track,) = tracks(tmp_path / "run")
    assert abs(track["summary"]["speed"] / MPH - 42.0) < 1.0


def test_a_box_in_the_left_view_alone_is_enough(scene, tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(scene, folder)
    text = (folder / "init.yaml").read_text(encoding="utf-8")
    quad = np.array(json.loads(text.split("left: ")[1].split(", right")[0]))
    (x0, y0), (x1, y1) = quad.min(axis=0), quad.max(axis=0)
    (folder / "init.yaml").write_text(
        f"targets:\n  - {{frame: 0, left: [{x0}, {y0}, {x1 - x0}, {y1 - y0}]}}\n", encoding="utf-8"
    )
    assert run(folder, "--out", tmp_path / "run", "--no-video", "--no-report").returncode == 0
    (track,) = tracks(tmp_path / "run")
    assert abs(track["summary"]["speed"] / MPH - 42.0) < 0.7


@pytest.mark.parametrize("option", ["smooth=false", "filter.path_constraint=false", "filter.kind=triangulation"])
def test_the_rivals_work_and_are_looser(scene, tmp_path, option):
    done = run(scene, "--out", tmp_path / "run", "--no-video", "--no-report", "--set", option)
    assert done.returncode == 0, done.stderr
    (track,) = tracks(tmp_path / "run")
    assert abs(track["summary"]["speed"] / MPH - 42.0) < 3.0


def test_a_kitti_file_is_a_calibration_too(tmp_path):
    made = straight_pass(33, mph=40.0)
    rectified = replace(made, R=np.eye(3), T=np.array([-0.5, 0.0, 0.0]))
    write_pass(rectified, tmp_path / "scene")
    (tmp_path / "scene" / "calibration.yaml").unlink()
    pair = {f"P{k}": rectified.K @ np.column_stack([np.eye(3), (k % 2) * rectified.T]) for k in range(4)}
    lines = [f"{name}: " + " ".join(f"{value:.12e}" for value in P.ravel()) for name, P in pair.items()]
    (tmp_path / "scene" / "calib.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    options = ("--no-video", "--no-report", "--set", "observation.parts=7")
    assert run(tmp_path / "scene", "--out", tmp_path / "run", *options).returncode == 0
    (track,) = tracks(tmp_path / "run")
    assert abs(track["summary"]["speed"] / MPH - 40.0) < 0.5


def test_few_particles_give_a_looser_track_and_no_nonsense(scene, tmp_path):
    options = ("--no-video", "--no-report", "--set", "smooth=false", "--set", "filter.particles=20")
    done = run(scene, "--out", tmp_path / "run", *options, "--set", "filter.sigma_v=0.05")
    assert done.returncode == 0, done.stderr
    (track,) = tracks(tmp_path / "run")
    assert all(state["speed_sigma"] > 0 for state in track["states"])
    assert all(np.linalg.eigvalsh(np.array(state["covariance"])).min() > 0 for state in track["states"])


def test_a_curved_path_is_followed(tmp_path):
    write_pass(straight_pass(32, mph=36.0, radius=55.0), tmp_path / "scene")
    assert run(tmp_path / "scene", "--out", tmp_path / "run", "--no-video", "--no-report").returncode == 0
    (track,) = tracks(tmp_path / "run")
    assert abs(track["summary"]["speed"] / MPH - 36.0) < 1.0


GOOD = (
    "targets: [{frame: 0, left: [100, 100, 50, 40], right: [[90, 100], [140, 100], [140, 140], [90, 140]], speed: 10}]"
)
BAD = {
    "no left": ({"left.mp4": None}, "has no view 'left'"),
    "no calibration": ({"calibration.yaml": None}, "has no calibration of the pair"),
    "broken video": ({"right.mp4": b"nothing"}, "right.mp4"),
    "calibration is text": ({"calibration.yaml": b"hello"}, "calibration.yaml"),
    "init is a list": ({"init.yaml": b"[1, 2]"}, "init.yaml: must hold targets"),
    "init without targets": ({"init.yaml": b"targets: []"}, "targets must be a list"),
    "init misspelt": ({"init.yaml": GOOD.replace("speed", "sped").encode()}, "unknown key 'sped'"),
    "init with words": ({"init.yaml": GOOD.replace("[100, 100, 50, 40]", "[a, b, c, d]").encode()}, "must be numbers"),
    "init with nan": ({"init.yaml": GOOD.replace("[100, 100", "[.nan, 100").encode()}, "not finite"),
    "quad runs backwards": (
        {"init.yaml": GOOD.replace("[[90, 100], [140, 100]", "[[140, 100], [90, 100]").encode()},
        "clockwise",
    ),
    "box outside": ({"init.yaml": GOOD.replace("[100, 100, 50, 40]", "[5000, 100, 50, 40]").encode()}, "lies outside"),
    "negative frame": ({"init.yaml": GOOD.replace("frame: 0", "frame: -1").encode()}, "is no frame's number"),
    "three numbers": ({"init.yaml": GOOD.replace("[100, 100, 50, 40]", "[1, 2, 3]").encode()}, "must be a box"),
    "broken yaml": ({"init.yaml": b"targets: [{"}, "not valid YAML"),
    "bomb": ({"init.yaml": b"a: &a [1]\nb: *a\n"}, "aliases"),
    "path of one view": ({"path.yaml": b"left: [[1, 2], [3, 4]]"}, "right is missing"),
    "path both ways": (
        {"path.yaml": b"left: [[1, 2], [3, 4]]\npoints: [[1, 2, 3], [4, 5, 6]]"},
        "either left and right",
    ),
    "path of one point": ({"path.yaml": b"points: [[1, 2, 3]]"}, "two or more points"),
    "path twice one point": ({"path.yaml": b"points: [[1, 2, 3], [1, 2, 3]]"}, "the same point twice"),
    "path of words": ({"path.yaml": b"points: [[a, b, c], [1, 2, 3]]"}, "must be numbers"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_scene_is_refused_in_one_line(case, scene, tmp_path):
    changed, fragment = BAD[case]
    folder = tmp_path / "scene"
    shutil.copytree(scene, folder)
    for name, content in changed.items():
        (folder / name).unlink(missing_ok=True)
        if content is not None:
            (folder / name).write_bytes(content)
    done = run(folder, "--out", tmp_path / "run")
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 3, done.stderr
    assert len(lines) == 1, done.stderr
    assert fragment in lines[0], lines[0]


def test_a_calibration_without_baseline_is_refused(scene, tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(scene, folder)
    file = cv2.FileStorage(str(folder / "calibration.yaml"), cv2.FILE_STORAGE_READ)
    kept = {name: file.getNode(name).mat() for name in ("M1", "D1", "M2", "D2", "R")}
    file.release()
    file = cv2.FileStorage(str(folder / "calibration.yaml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (kept | {"T": np.zeros((3, 1))}).items():
        file.write(name, value)
    file.release()
    done = run(folder, "--out", tmp_path / "run")
    assert done.returncode == 3
    assert "the cameras are 0 m apart" in done.stderr
