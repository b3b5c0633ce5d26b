"""`visfuse track-imm` in rendered rooms: positions, velocities, still scenes, bad sensors."""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from samples.head import room, write_head

pytestmark = pytest.mark.contract
STREET = Path(__file__).parents[2] / "shared" / "data" / "imm-street"
WHEELS = ("--set", "odometry.wheel_separation=0.4")


def run(*args):
    command = [sys.executable, "-m", "visfuse_cli", "track-imm", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    out = tmp_path_factory.mktemp("room")
    write_head(room(3, seconds=5.0), out, init=True)
    return out


@pytest.fixture(scope="module")
def result(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("result") / "run"
    done = run(scene, *WHEELS, "--set", "latency=0.2", "--out", out)
    assert done.returncode == 0, done.stderr
    return out


def tracks(out):
    return json.loads((out / "tracks.json").read_text(encoding="utf-8"))["tracks"]


def errors(scene, track):
    with open(scene / "truth.csv", newline="", encoding="utf-8") as file:
        truth = {
            int(row["frame"]): np.array([float(row[k]) for k in ("x", "y", "z", "vx", "vy", "vz")])
            for row in csv.DictReader(file)
        }
    return np.array([np.array([*s["position"], *s["velocity"]]) - truth[s["frame"]] for s in track["states"]])


def test_a_person_is_located_within_three_per_cent_of_the_range(scene, result):
    (track,) = tracks(result)
    off = errors(scene, track)
    assert len(off) > 60
    assert np.sqrt(np.mean(np.sum(off[:, :3] ** 2, axis=1))) < 0.15
    assert np.sqrt(np.mean(np.sum(off[5:, 3:] ** 2, axis=1))) < 0.3


def test_what_the_contract_promises_is_there(result):
    document = json.loads((result / "tracks.json").read_text(encoding="utf-8"))
    assert document["frame_of_reference"] == "left-camera-at-start"
    state = document["tracks"][0]["states"][10]
    assert set(state["box"]) == {"left", "right"}
    assert sum(state["models"].values()) == pytest.approx(1)
    assert state["ahead"]["t"] == pytest.approx(state["t"] + 0.2)
    assert np.linalg.eigvalsh(np.array(state["covariance"])).min() > 0
    for name in ("annotated.mp4", "report.html", "run.json"):
        assert (result / name).stat().st_size > 1000
    run_json = json.loads((result / "run.json").read_text(encoding="utf-8"))
    assert len(run_json["ego"]["position"]) == 75


def test_nobody_needs_to_name_the_person(scene, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(scene, bare)
    (bare / "init.yaml").unlink()
    done = run(bare, *WHEELS, "--out", tmp_path / "run", "--no-video", "--no-report")
    assert done.returncode == 0, done.stderr
    track = tracks(tmp_path / "run")[0]
    off = errors(scene, track)
    assert np.sqrt(np.mean(np.sum(off[:, :3] ** 2, axis=1))) < 0.2
    cov = np.array([state["covariance"] for state in track["states"]])[:, :3, :3]
    normalised = np.einsum("ti,ti->t", off[:, :3], np.linalg.solve(cov, off[:, :3, None])[..., 0])
    assert np.median(normalised) < 12  # a box that was found lies off its target, and the covariance says so


def test_the_same_input_gives_the_same_bytes(scene, tmp_path):
    for name in ("one", "two"):
        assert run(scene, *WHEELS, "--end", 2, "--out", tmp_path / name, "--no-video", "--no-report").returncode == 0
    assert (tmp_path / "one" / "tracks.json").read_bytes() == (tmp_path / "two" / "tracks.json").read_bytes()


@pytest.mark.parametrize("kind", ["drifting", "cv", "ca", "periodic"])
def test_each_model_works_alone(scene, tmp_path, kind):
    done = run(scene, *WHEELS, "--set", f"filter.kind={kind}", "--out", tmp_path / "run", "--no-video", "--no-report")
    assert done.returncode == 0, done.stderr
    (track,) = tracks(tmp_path / "run")
    assert "models" not in track["states"][0]
    assert np.sqrt(np.mean(np.sum(errors(scene, track)[:, :3] ** 2, axis=1))) < 0.3


def test_a_still_room_has_no_targets(tmp_path):
    write_head(room(5, still=True, seconds=4.0), tmp_path / "scene")
    done = run(tmp_path / "scene", *WHEELS, "--out", tmp_path / "run", "--no-video", "--no-report")
    assert done.returncode == 0, done.stderr
    assert tracks(tmp_path / "run") == []


def test_volts_and_poses_say_the_same_as_wheels(scene, result, tmp_path):
    volts = tmp_path / "volts"
    shutil.copytree(scene, volts)
    rows = (scene / "sensors.csv").read_text(encoding="utf-8").splitlines()
    values = np.array([[float(x) for x in row.split(",")] for row in rows[1:]])
    text = "\n".join(f"{t:.3f},{a / 0.25:.8f},{b / 0.25:.8f}" for t, a, b in values)
    (volts / "sensors.csv").write_text("t,u1,u2\n" + text + "\n", encoding="utf-8")
    done = run(volts, *WHEELS, "--set", "odometry.k_t=0.25", "--out", tmp_path / "run", "--no-video", "--no-report")
    assert done.returncode == 0, done.stderr
    one, other = (np.array([s["position"] for s in tracks(out)[0]["states"]]) for out in (result, tmp_path / "run"))
    np.testing.assert_allclose(one, other, atol=1e-4)


@pytest.mark.skipif(not STREET.is_dir(), reason="the recordings lie beside the project; they are not here")
def test_a_parked_car_stands_still_while_the_camera_drives(tmp_path):
    done = run(
        STREET, "--config", "street", "--set", "video.fps=10", "--out", tmp_path / "run", "--no-video", "--no-report"
    )
    assert done.returncode == 0, done.stderr
    (track,) = tracks(tmp_path / "run")
    places = np.array([state["position"] for state in track["states"]])
    assert sum(state["measured"] for state in track["states"]) >= 8
    assert np.median([state["speed"] for state in track["states"]]) < 1.0
    assert np.linalg.norm(places - np.median(places, axis=0), axis=1).max() < 1.0


def test_two_who_cross_keep_their_identities(tmp_path):
    out = tmp_path / "crossing"
    write_head(room(1, people=2, seconds=4.0, size=(192, 164)), out, init=True)
    done = run(out, *WHEELS, "--out", tmp_path / "run", "--no-video", "--no-report")
    assert done.returncode == 0, done.stderr
    with open(out / "truth.csv", newline="", encoding="utf-8") as file:
        truth = {(int(r["id"]), int(r["frame"])): [float(r[k]) for k in "xyz"] for r in csv.DictReader(file)}
    assert [track["id"] for track in tracks(tmp_path / "run")] == [1, 2]
    for track in tracks(tmp_path / "run"):
        states = [s for s in track["states"] if (track["id"], s["frame"]) in truth]
        off = [np.subtract(s["position"], truth[track["id"], s["frame"]]) for s in states]
        assert len(off) > 30
        assert np.linalg.norm(off, axis=1).max() < 0.25


BAD = {
    "no sensors": (None, "has no sensors"),
    "empty sensors": ("", "is empty"),
    "unknown columns": ("a,b,c\n1,2,3\n4,5,6\n", "are none of"),
    "one sample": ("t,v1,v2\n0,1,1\n", "two or more are needed"),
    "word": ("t,v1,v2\n0,1,1\n1,x,1\n", "line 3, column v1: 'x' is not a number"),
    "nan": ("t,v1,v2\n0,1,1\n1,nan,1\n", "line 3, column v1: nan is not finite"),
    "short row": ("t,v1,v2\n0,1,1\n1,1\n", "line 3: 2 columns"),
    "times fall": ("t,v1,v2\n0,1,1\n1,1,1\n0.5,1,1\n", "line 4, column t"),
    "times repeat": ("t,v1,v2\n0,1,1\n0,1,1\n", "line 3, column t"),
    "too short": ("t,v1,v2\n0,1,1\n0.5,1,1\n", "samples run from t = 0 to 0.5 s"),
    "twin column": ("t,v1,v2,v1\n0,1,1,1\n1,1,1,1\n", "given twice"),
    "gaze": ("t,elevation,vergence\n0,0,0\n9,0,0\n", "gaze angles"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_sensors_are_refused_in_one_line(case, scene, tmp_path):
    content, fragment = BAD[case]
    folder = tmp_path / "scene"
    shutil.copytree(scene, folder)
    (folder / "sensors.csv").unlink()
    if content is not None:
        (folder / "sensors.csv").write_text(content, encoding="utf-8")
    done = run(folder, *WHEELS, "--out", tmp_path / "run", "--no-video")
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 3, done.stderr
    assert len(lines) == 1, done.stderr
    assert fragment in lines[0], lines[0]
    assert not (tmp_path / "run" / "tracks.json").exists()


def test_a_gap_in_the_samples_is_reported(scene, tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(scene, folder)
    rows = (folder / "sensors.csv").read_text(encoding="utf-8").splitlines()
    kept = [rows[0], *(row for row in rows[1:] if not 1.5 < float(row.split(",")[0]) < 3.0)]
    (folder / "sensors.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")
    done = run(folder, *WHEELS, "--out", tmp_path / "run", "--no-video", "--no-report")
    assert done.returncode == 0
    assert "1 gap in the samples" in done.stderr
