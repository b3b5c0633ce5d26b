"""`visfuse fuse-cameras` on rendered yards: people found, followed and located; cameras that do not fit are named."""

import csv
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

from samples.files import write_clip
from samples.people import crossing
from samples.yard import frames, write_calibration, write_yard
from visfuse_cli.fusing import clocks

pytestmark = pytest.mark.contract
SQUARE = Path(__file__).parents[2] / "shared" / "data" / "fuse-square"


def run(*args):
    command = [sys.executable, "-m", "visfuse_cli", "fuse-cameras", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def yard():
    return crossing(21, seconds=7.0, people=2, size=(384, 288), fps=Fraction(12))


@pytest.fixture(scope="module")
def scene(yard, tmp_path_factory):
    out = tmp_path_factory.mktemp("yard")
    write_yard(yard, out)
    return out


@pytest.fixture(scope="module")
def result(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("result") / "run"
    done = run(scene, "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    return out, json.loads(done.stdout)


def truth_of(scene: Path) -> dict[tuple[int, int], np.ndarray]:
    with open(scene / "truth.csv", newline="", encoding="utf-8") as file:
        return {
            (int(row["frame"]), int(row["id"])): np.array([float(row[k]) for k in ("x", "y", "z", "vx", "vy", "vz")])
            for row in csv.DictReader(file)
        }


def errors(scene: Path, out: Path) -> dict[int, np.ndarray]:
    """Errors (n, 6) by true person, of the track nearest to it over the clip."""
    truth, found = truth_of(scene), {}
    tracks = json.loads((out / "tracks.json").read_text(encoding="utf-8"))["tracks"]
    for identity in sorted({who for _, who in truth}):
        best = None
        for track in tracks:
            rows = np.array(
                [
                    np.concatenate([state["position"], state["velocity"]]) - truth[state["frame"], identity]
                    for state in track["states"]
                    if (state["frame"], identity) in truth
                ]
            )
            if best is None or np.median(np.abs(rows)) < np.median(np.abs(best)):
                best = rows
        found[identity] = best
    return found


def test_everybody_is_found_once_and_located_to_a_few_centimetres(scene, result):
    out, summary = result
    assert summary["people"] == 2
    off = errors(scene, out)
    for rows in off.values():
        assert len(rows) > 0.93 * 7 * 12
        assert np.sqrt(np.mean(np.sum(rows[:, :3] ** 2, axis=1))) < 0.08
        assert np.abs(rows[:, :3]).max() < 0.3  # also where they cross: nobody changes hands


def test_the_covariance_holds_the_error(scene, result):
    tracks = json.loads((result[0] / "tracks.json").read_text(encoding="utf-8"))["tracks"]
    truth = truth_of(scene)
    inside = []
    for track in tracks:
        start = np.array(track["states"][0]["position"])
        who = min((1, 2), key=lambda k: np.linalg.norm(truth[0, k][:3] - start))
        for state in track["states"]:
            off = np.array([*state["position"], *state["velocity"]]) - truth[state["frame"], who]
            inside.append(off @ np.linalg.solve(np.array(state["covariance"]), off))
    assert 0.5 < np.mean(inside) < 14  # of 6 degrees of freedom; one scene scatters


def test_what_the_contract_promises_is_there(result):
    out, summary = result
    document = json.loads((out / "tracks.json").read_text(encoding="utf-8"))
    assert document["schema"] == "visfuse.tracks/1"
    assert document["frame_of_reference"] == "world"
    for name in ("cam1", "cam2", "cam3", "cam4"):
        assert (out / f"annotated-{name}.mp4").stat().st_size > 10_000
        assert summary["per_camera"][name]["sightings"] > 50
        assert summary["per_camera"][name]["reprojection_px"] < 6
    for name in ("map.png", "mosaic.mp4", "report.html", "run.json"):
        assert (out / name).is_file()
    state = document["tracks"][0]["states"][10]
    assert len(state["position"]) == 3
    assert np.array(state["covariance"]).shape == (6, 6)
    assert set(state["box"]) <= {"cam1", "cam2", "cam3", "cam4"}
    assert not json.loads((out / "run.json").read_text(encoding="utf-8"))["warnings"]


def test_the_same_input_gives_the_same_bytes(scene, result, tmp_path):
    assert run(scene, "--out", tmp_path / "again", "--no-video", "--no-report").returncode == 0
    again = (tmp_path / "again" / "tracks.json").read_bytes()
    assert again == (result[0] / "tracks.json").read_bytes()


def test_feet_by_config_lie_on_the_ground(scene, tmp_path):
    out = tmp_path / "run"
    assert run(scene, "--out", out, "--no-video", "--no-report", "--set", "fusion.point=foot").returncode == 0
    tracks = json.loads((out / "tracks.json").read_text(encoding="utf-8"))["tracks"]
    assert len(tracks) == 2
    assert abs(np.median([state["position"][2] for track in tracks for state in track["states"]])) < 0.06


def test_a_camera_that_was_turned_is_named_and_does_no_harm(yard, scene, tmp_path):
    turned = tmp_path / "turned"
    shutil.copytree(scene, turned)
    axis = np.array([0.2, 1.0, 0.1]) / np.linalg.norm([0.2, 1.0, 0.1])
    write_calibration(turned / "calibration.toml", yard, {"cam2": cv2.Rodrigues(axis * np.radians(5))[0]})
    done = run(turned, "--out", tmp_path / "run", "--no-video", "--no-report")
    assert done.returncode == 0
    assert "camera 'cam2' does not fit the others" in done.stderr
    for rows in errors(scene, tmp_path / "run").values():
        assert np.sqrt(np.mean(np.sum(rows[:, :3] ** 2, axis=1))) < 0.16


def test_a_late_camera_is_named_and_its_offset_found(yard, scene, tmp_path):
    late = tmp_path / "late"
    shutil.copytree(scene, late)
    slow = replace(yard, delays=yard.delays | {"cam3": 0.3})
    write_clip(late / "cam3.mp4", frames(slow, "cam3"), yard.cameras["cam3"].size, yard.rates["cam3"], 23)
    done = run(late, "--out", tmp_path / "run", "--no-video", "--no-report", "--estimate-offsets", "--json")
    assert done.returncode == 0, done.stderr
    offsets = json.loads(done.stdout)["offsets"]
    assert offsets["cam1"] == 0
    assert abs(offsets["cam3"] - 0.3) < 0.05
    assert abs(offsets["cam2"]) < 0.05
    assert abs(offsets["cam4"]) < 0.05
    done = run(late, "--out", tmp_path / "plain", "--no-video", "--no-report")
    assert "camera 'cam3' is about" in done.stderr
    assert "--estimate-offsets" in done.stderr


def test_clocks_are_told_from_where_people_walk():
    t = np.arange(0, 20, 0.2)
    walk = np.column_stack([3 * np.sin(0.5 * t), 2 * np.cos(0.4 * t)])
    one, other = clocks.Walks(), clocks.Walks()
    for k, now in enumerate(t):
        one.add(now, walk[k : k + 1])
        other.add(now - 1.4, walk[k : k + 1] + 0.1)  # its clock began 1.4 s later
    found = clocks.coarse([one, other], np.zeros(2), 3.0)
    np.testing.assert_allclose(found, [0, 1.4], atol=0.2)
    assert clocks.coarse([one, clocks.Walks()], np.zeros(2), 3.0) is None


@pytest.fixture(scope="module")
def boxes(yard, scene, result, tmp_path_factory):
    """The scene as a detector would tell it: the boxes that were found, without their owners."""
    out = tmp_path_factory.mktemp("boxes")
    shutil.copy(scene / "calibration.toml", out)
    tracks = json.loads((result[0] / "tracks.json").read_text(encoding="utf-8"))["tracks"]
    for name in yard.cameras:
        rows = []
        for track in tracks:
            for state in track["states"]:
                if name in state["box"]:
                    x, y, w, h = state["box"][name]
                    rows.append(f"{state['frame'] + 1},-1,{x:.2f},{y:.2f},{w:.2f},{h:.2f},1")
        (out / f"{name}.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return out


@pytest.mark.parametrize("method", ["closed-loop", "naive", "kim", "covariance-intersection", "central"])
def test_boxes_alone_are_enough_whatever_the_way_of_fusion(scene, boxes, tmp_path, method):
    out = tmp_path / "run"
    done = run(boxes, "--out", out, "--no-report", "--set", "video.fps=12", "--set", f"fusion.method={method}")
    assert done.returncode == 0, done.stderr
    assert not list(out.glob("annotated*"))
    for rows in errors(scene, out).values():
        assert np.sqrt(np.mean(np.sum(rows[:, :3] ** 2, axis=1))) < 0.12


def test_one_camera_alone_follows_on_and_says_how_doubtfully(scene, boxes, tmp_path):
    last = 50  # frame after which the others are blind
    for name in ("cam1", "cam2", "cam3", "cam4"):
        rows = (boxes / f"{name}.txt").read_text(encoding="utf-8").splitlines()
        kept = [row for row in rows if name == "cam1" or int(row.split(",")[0]) <= last]
        (tmp_path / f"{name}.txt").write_text("\n".join(kept) + "\n", encoding="utf-8")
    shutil.copy(boxes / "calibration.toml", tmp_path)
    done = run(tmp_path, "--out", tmp_path / "run", "--no-report", "--set", "video.fps=12", "--set", "life.max_doubt=9")
    assert done.returncode == 0, done.stderr
    truth, inside = truth_of(scene), []
    for track in json.loads((tmp_path / "run" / "tracks.json").read_text(encoding="utf-8"))["tracks"]:
        states = [state for state in track["states"] if state["frame"] >= last + 6 and list(state["box"]) == ["cam1"]]
        for state in states:
            who = min((1, 2), key=lambda k: np.linalg.norm(truth[state["frame"], k][:3] - state["position"]))
            off = np.array(state["position"]) - truth[state["frame"], who][:3]
            sigma = np.sqrt(np.diag(state["covariance"])[:3])
            assert np.linalg.norm(off) < 0.5
            inside.append(np.all(np.abs(off) < 3 * sigma))
            assert np.linalg.norm(sigma[:2]) > 0.06  # more than what several cameras leave
    assert len(inside) > 20
    assert np.mean(inside) > 0.8


@pytest.mark.skipif(not SQUARE.is_dir(), reason="the recordings lie beside the project; they are not here")
def test_a_real_crowd_of_boxes(tmp_path):
    done = run(SQUARE, "--config", "crowd", "--set", "video.fps=2", "--out", tmp_path / "run", "--json", "--no-report")
    assert done.returncode == 0, done.stderr
    truth = truth_of_square()
    tracks = json.loads((tmp_path / "run" / "tracks.json").read_text(encoding="utf-8"))["tracks"]
    found: dict[int, list[np.ndarray]] = {}
    for track in tracks:
        for state in track["states"]:
            found.setdefault(state["frame"], []).append(np.array(state["position"][:2]))
    hits, wrong, total = 0, 0, 0
    for frame, people in truth.items():
        there = np.array(found.get(frame, np.zeros((0, 2)))).reshape(-1, 2)
        near = np.linalg.norm(np.array(people)[:, None] - there[None], axis=-1) < 0.5
        matched = int(min(near.any(axis=1).sum(), near.any(axis=0).sum()))
        hits, wrong, total = hits + matched, wrong + len(there) - matched, total + len(people)
    assert (hits - wrong) / total > 0.88


def truth_of_square():
    people: dict[int, list[list[float]]] = {}
    with open(SQUARE / "truth.csv", newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            people.setdefault(int(row["frame"]), []).append([float(row["x"]), float(row["y"])])
    return people


TABLE = """[cam_1]
name = "a"
size = [64, 48]
matrix = [[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0, 0.0]
rotation = [1.8, 0.0, 0.0]
translation = [0.0, 1.0, 4.0]
"""
OTHER = TABLE.replace("cam_1", "cam_2").replace('"a"', '"b"').replace("[1.8, 0.0, 0.0]", "[1.2, 1.2, -1.0]")
BOXES = "1,-1,10,10,5,10,1\n2,-1,11,10,5,10,1\n"
BAD = {
    "no calibration": ({"calibration.toml": None}, 3, "has no calibration"),
    "broken toml": ({"calibration.toml": TABLE + "size = ["}, 3, "not valid TOML"),
    "binary toml": ({"calibration.toml": b"\xff\xfe\x00"}, 3, "calibration.toml"),
    "empty toml": ({"calibration.toml": ""}, 3, "calibration.toml"),
    "one camera": ({"calibration.toml": TABLE}, 3, "fusing needs two or more"),
    "key missing": ({"calibration.toml": TABLE.replace("rotation", "turn") + OTHER}, 3, "rotation missing"),
    "matrix of two rows": (
        {"calibration.toml": TABLE.replace("[0.0, 50.0, 24.0], ", "") + OTHER},
        3,
        "matrix: must be 3x3",
    ),
    "matrix is none": ({"calibration.toml": TABLE.replace("[[50.0", "[[0.0") + OTHER}, 3, "not a camera matrix"),
    "nan": (
        {"calibration.toml": TABLE.replace("1.0, 4.0", "nan, 4.0") + OTHER},
        3,
        "translation: holds what is no finite",
    ),
    "millimetres": ({"calibration.toml": TABLE.replace("1.0, 4.0", "1000.0, 4000.0") + OTHER}, 3, "must be in metres"),
    "twice one name": ({"calibration.toml": TABLE + OTHER.replace('"b"', '"a"')}, 3, "two cameras are called 'a'"),
    "path as name": ({"calibration.toml": TABLE.replace('"a"', '"../a"') + OTHER}, 3, "cannot be the name of a file"),
    "size of words": ({"calibration.toml": TABLE.replace("[64, 48]", '["w", "h"]') + OTHER}, 3, "size: must be"),
    "fisheye": ({"calibration.toml": TABLE + "fisheye = true\n" + OTHER}, 3, "fisheye"),
    "no footage": ({"b.txt": None}, 3, "camera 'b' of the calibration has no footage"),
    "word in boxes": ({"b.txt": "1,-1,x,10,5,10,1\n"}, 3, "b.txt, line 1, column x"),
    "frame 0": ({"b.txt": "0,-1,1,10,5,10,1\n"}, 3, "b.txt, line 1, column frame"),
    "empty boxes": ({"a.txt": "", "b.txt": ""}, 3, "no box at all"),
    "video is text": ({"a.txt": None, "b.txt": None, "a.mp4": "hello", "b.mp4": "hello"}, 3, "a.mp4"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_scene_is_refused_in_one_line(case, tmp_path):
    changed, code, fragment = BAD[case]
    folder = tmp_path / "scene"
    folder.mkdir()
    for name, content in ({"calibration.toml": TABLE + OTHER, "a.txt": BOXES, "b.txt": BOXES} | changed).items():
        if content is not None:
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    done = run(folder, "--set", "video.fps=10", "--out", tmp_path / "run")
    refused(done, code, fragment)
    assert not (tmp_path / "run" / "tracks.json").exists()


def refused(done, code, fragment):
    lines = done.stderr.strip().splitlines()
    assert done.returncode == code, done.stderr
    assert len(lines) == 1, done.stderr
    assert fragment in lines[0], lines[0]


@pytest.mark.parametrize(
    ("args", "code", "fragment"),
    [
        ([], 3, "boxes carry no times; set video.fps"),
        (["--set", "video.fps=10", "--set", "fusion.offsets={c: 0.1}"], 2, "no camera 'c'"),
        (["--set", "video.fps=10", "--set", "fusion.method=magic"], 2, "fusion.method"),
        (["--set", "video.fps=10", "--set", "world.ground=[0, 0, 0, 1]"], 2, "that is no plane"),
        (["--set", "video.fps=10", "--set", "world.ground=[0, 0, -1, 0]"], 3, "below the ground"),
        (["--set", "video.fps=10", "--set", "fusion.metod=naive"], 2, "did you mean 'method'"),
    ],
)
def test_a_bad_option_is_refused_in_one_line(args, code, fragment, tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    for name, content in {"calibration.toml": TABLE + OTHER, "a.txt": BOXES, "b.txt": BOXES}.items():
        (folder / name).write_text(content, encoding="utf-8")
    refused(run(folder, *args, "--out", tmp_path / "run"), code, fragment)


def test_shares_are_for_boxes_only(scene, tmp_path):
    refused(run(scene, "--out", tmp_path / "run", "--set", "sight.association=jpda"), 2, "sight.association")


def test_footage_of_another_size_is_refused(scene, tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(scene, folder)
    text = (folder / "calibration.toml").read_text(encoding="utf-8")
    (folder / "calibration.toml").write_text(text.replace("[384, 288]", "[640, 480]"), encoding="utf-8")
    refused(run(folder, "--out", tmp_path / "run"), 3, "384x288, but camera 'cam1' was calibrated for 640x480")
