"""What scripts rely on: files, keys, columns, bytes, streams -- through the real executable."""

import csv
import json
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest

from samples.files import write_scene
from samples.road import free_flow

pytestmark = pytest.mark.contract
SPEEDS = """clip track_id t_start t_end time_utc direction lane speed_kmh ci95_low_kmh ci95_high_kmh
distance_m n_frames""".split()


def table(path):
    with open(path, newline="") as file:
        return list(csv.reader(file))


def rows(path):
    head, *body = table(path)
    return [dict(zip(head, row, strict=True)) for row in body]


def run(*args):
    command = [sys.executable, "-m", "visfuse_cli", *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    write_scene(free_flow(4, 6, size=(640, 360)), folder)
    run(
        "calibrate-homography",
        "--points",
        folder / "points.csv",
        "--image",
        folder / "clip.mp4",
        "--out",
        folder / "H.json",
    )
    return folder


@pytest.fixture(scope="module")
def measured(scene):
    run("speed", scene / "clip.mp4", "--homography", scene / "H.json", "--out", scene / "run")
    return scene / "run"


def test_homography_file(scene):
    document = json.loads((scene / "H.json").read_text())
    assert document["schema"] == "visfuse.homography/1"
    assert document["input"] == "pixel"
    assert document["image_size"] == [640, 360]
    assert document["lens"] is None
    assert np.shape(document["H"]) == (3, 3)
    assert document["H"][2][2] == 1
    assert np.linalg.matrix_rank(np.array(document["covariance"])[:8, :8]) == 8
    assert np.allclose(np.array(document["covariance"])[8], 0)
    assert document["ground_sign"] in (1, -1)
    assert set(document["residuals"][0]) >= {"index", "error_m", "error_px", "leave_one_out_m", "used"}
    assert document["source"] == "points.csv"
    assert cv2.imread(str(scene / "H.png")).shape == (360, 640, 3)


def test_gaze_and_lines(tmp_path):
    (tmp_path / "gaze.csv").write_text(
        "elevation,vergence,X,Y\n-0.2,0.3,-6,20\n-0.2,-0.3,6,20\n-0.4,0.35,-4,9\n-0.4,-0.35,4,9\n-0.3,0,0,12.9\n"
    )
    run("calibrate-homography", "--gaze", tmp_path / "gaze.csv", "--out", tmp_path / "gaze.json")
    assert json.loads((tmp_path / "gaze.json").read_text())["input"] == "gaze"
    (tmp_path / "lines.csv").write_text(
        "u1,v1,u2,v2,X1,Y1,X2,Y2\n100,400,200,100,0,0,0,30\n600,400,420,100,10,0,10,30\n"
        "100,400,600,400,0,0,10,0\n200,100,420,100,0,30,10,30\n"
    )
    run("calibrate-homography", "--lines", tmp_path / "lines.csv", "--out", tmp_path / "lines.json")
    H = np.array(json.loads((tmp_path / "lines.json").read_text())["H"])
    corner = H @ [600, 400, 1]
    np.testing.assert_allclose(corner[:2] / corner[2], [10, 0], atol=1e-6)


def test_tables_and_tracks(measured):
    speeds = rows(measured / "speeds.csv")
    assert list(speeds[0]) == SPEEDS
    assert table(measured / "rejected.csv")[0] == [*SPEEDS, "reason"]
    document = json.loads((measured / "tracks.json").read_text())
    assert document["schema"] == "visfuse.tracks/1"
    assert document["command"] == "speed"
    assert document["frame_of_reference"] == "ground"
    ids = [track["id"] for track in document["tracks"]]
    assert ids == sorted(set(ids))
    by_id = {track["id"]: track for track in document["tracks"]}
    for row in speeds:
        summary = by_id[int(row["track_id"])]["summary"]
        assert summary["speed"] * 3.6 == pytest.approx(float(row["speed_kmh"]), abs=0.01)
        assert float(row["ci95_low_kmh"]) < float(row["speed_kmh"]) < float(row["ci95_high_kmh"])
        assert summary["t_start"] < summary["t_end"]
    state = by_id[int(speeds[0]["track_id"])]["states"][0]
    assert len(state["position"]) == len(state["velocity"]) == 2
    assert np.linalg.eigvalsh(np.array(state["covariance"])).min() > 0
    assert len(state["box"]["image"]) == 4
    assert isinstance(state["measured"], bool)


def test_run_json(measured, scene):
    document = json.loads((measured / "run.json").read_text())
    assert document["config"]["filter"]["kind"] == "fading"
    assert document["time_audit"]["clip.mp4"]["frames"] == 150
    assert len(document["inputs"][0]["sha256"]) == 64
    assert document["counts"]["frames"] == 150
    assert document["seconds_per_stage"]["track"] >= 0


def test_same_inputs_same_bytes(scene, measured, tmp_path):
    run("speed", scene / "clip.mp4", "--homography", scene / "H.json", "--out", tmp_path / "again", "--no-video")
    for name in ("tracks.json", "speeds.csv", "rejected.csv"):
        assert (measured / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_streams(scene, tmp_path):
    options = ("speed", scene / "clip.mp4", "--homography", scene / "H.json", "--no-video", "--end", "1")
    done = run(*options, "--out", tmp_path / "a", "--json")
    assert json.loads(done.stdout)["frames"] == 25
    assert done.stderr == ""
    for number, arguments in enumerate((("-q", *options), (*options, "-q"))):
        done = run(*arguments, "--out", tmp_path / str(number))
        assert done.stdout == done.stderr == ""


def test_images_with_times_equal_the_clip(scene, tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    reader = cv2.VideoCapture(str(scene / "clip.mp4"))
    count = 0
    while True:
        ok, frame = reader.read()
        if not ok:
            break
        cv2.imwrite(str(images / f"{count}.png"), frame)
        count += 1
    options = ("--homography", scene / "H.json", "--no-video")
    run("speed", images, *options, "--set", "video.fps=25", "--out", tmp_path / "rate")
    (images / "timestamps.csv").write_text("frame,t\n" + "".join(f"{k},{k / 25}\n" for k in range(count)))
    run("speed", images, *options, "--out", tmp_path / "stamps")
    for name in ("rate", "stamps"):
        assert len(rows(tmp_path / name / "speeds.csv")) >= 1


def test_folder_of_clips(scene, tmp_path):
    clips = tmp_path / "clips"
    clips.mkdir()
    for name in ("a.mp4", "b.mp4"):
        shutil.copy(scene / "clip.mp4", clips / name)
    run("speed", clips, "--homography", scene / "H.json", "--out", tmp_path / "run", "--end", "3")
    assert {"annotated-a.mp4", "annotated-b.mp4"} <= {path.name for path in (tmp_path / "run").iterdir()}
    tracks = json.loads((tmp_path / "run" / "tracks.json").read_text())["tracks"]
    assert {track["clip"] for track in tracks} == {"a.mp4", "b.mp4"}
    assert len({track["id"] for track in tracks}) == len(tracks)


def test_external_detections(scene, measured, tmp_path):
    tracks = json.loads((measured / "tracks.json").read_text())["tracks"]
    boxes = [
        f"{state['frame'] + 1},-1,{','.join(f'{v:.2f}' for v in state['box']['image'])},1\n"
        for track in tracks
        if track["summary"]["rejected"] is None
        for state in track["states"]
    ]
    (tmp_path / "boxes.txt").write_text("".join(boxes))
    options = ("--homography", scene / "H.json", "--detections", tmp_path / "boxes.txt", "--no-video")
    run("speed", scene / "clip.mp4", *options, "--out", tmp_path / "run")
    ours = [float(r["speed_kmh"]) for r in rows(measured / "speeds.csv")]
    theirs = [float(r["speed_kmh"]) for r in rows(tmp_path / "run" / "speeds.csv")]
    assert theirs
    assert min(abs(a - b) for a in ours for b in theirs) < 4


def test_people_and_causal_output(scene, tmp_path):
    options = ("speed", scene / "clip.mp4", "--homography", scene / "H.json", "--no-video", "--end", "2")
    run(*options, "--config", "pedestrians", "--out", tmp_path / "people")
    run(*options, "--set", "smooth=false", "--set", "filter.kind=ekf", "--out", tmp_path / "causal")
    assert (tmp_path / "causal" / "speeds.csv").exists()


def test_configuration_commands():
    assert "kind: fading" in run("config", "show", "speed", "traffic").stdout
    assert "constant-velocity" in run("config", "show", "speed", "pedestrians").stdout
    assert json.loads(run("config", "schema", "speed").stdout)["title"] == "SpeedConfig"
    assert run("--version").stdout.startswith("visfuse 0.")
