"""`visfuse evaluate`: errors that are known, verdicts, a radar's table, bad input."""

import json
import subprocess
import sys

import numpy as np
import pytest

pytestmark = pytest.mark.contract
HEADER = "frame,t,id,x,y,z,vx,vy,vz\n"


def run(*args):
    command = [sys.executable, "-m", "visfuse_cli", "evaluate", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@pytest.fixture
def folder(tmp_path):
    """Two tracks whose errors are drawn from what they state, 0.1 m and 0.2 m/s, the first 0.05 m/s too fast."""
    rng = np.random.default_rng(1)
    tracks, rows = [], []
    cov = np.diag([0.01, 0.01, 0.04, 0.04])
    for identity in (1, 2):
        states = []
        for frame in range(40):
            t = frame / 10
            true = np.array([5.0 * t, 4.0 * identity, 5.0, 0.0])
            mean = true + rng.multivariate_normal(np.zeros(4), cov)
            rows.append(f"{frame},{t},{identity + 10},{true[0]},{true[1]},,{true[2]},{true[3]},")
            states.append(
                {
                    "frame": frame,
                    "t": t,
                    "position": mean[:2].tolist(),
                    "velocity": mean[2:].tolist(),
                    "covariance": cov.tolist(),
                    "speed": float(np.linalg.norm(mean[2:])),
                    "speed_sigma": 0.2,
                }
            )
        summary = {"t_start": 0.0, "t_end": 3.9, "speed": 5.0 + 0.1 * identity, "n_frames": 40}
        tracks.append({"id": identity, "summary": summary, "states": states})
    (tmp_path / "tracks.json").write_text(json.dumps({"tracks": tracks}), encoding="utf-8")
    (tmp_path / "truth.csv").write_text(HEADER + "\n".join(rows) + "\n", encoding="utf-8")
    return tmp_path


def test_known_errors_are_found(folder):
    done = run(folder, "--truth", folder / "truth.csv", "--gate", 1, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["matched"], found["missed"], found["false"], found["switches"]) == (80, 0, 0, 0)
    assert found["moda"] == 1
    assert found["position_m"]["rmse"] == pytest.approx(0.1 * np.sqrt(2), rel=0.2)
    assert found["velocity_m_s"]["rmse"] == pytest.approx(0.2 * np.sqrt(2), rel=0.2)
    assert found["speed_interval_coverage"] > 0.85
    assert found["nees"]["verdict"] == "consistent"
    assert json.loads((folder / "evaluation.json").read_text(encoding="utf-8")) == found


def test_a_track_that_changes_hands_is_counted(folder):
    document = json.loads((folder / "tracks.json").read_text(encoding="utf-8"))
    one, two = document["tracks"]
    one["states"][20:], two["states"][20:] = two["states"][20:], one["states"][20:]
    (folder / "tracks.json").write_text(json.dumps(document), encoding="utf-8")
    found = json.loads(run(folder, "--truth", folder / "truth.csv", "--json").stdout)
    assert found["switches"] == 2


def test_states_outside_of_the_gate_are_missed_and_false(folder):
    rows = (folder / "truth.csv").read_text(encoding="utf-8").splitlines()
    far = [row.replace(",8.0,,", ",80.0,,") if ",12," in row else row for row in rows]
    (folder / "far.csv").write_text("\n".join(far) + "\n", encoding="utf-8")
    found = json.loads(run(folder, "--truth", folder / "far.csv", "--json").stdout)
    assert (found["matched"], found["missed"], found["false"]) == (40, 40, 40)
    assert found["moda"] == 0


def test_a_radar_is_agreed_with_but_for_the_bias(folder):
    (folder / "radar.csv").write_text("t,speed_kmh\n1.5,18\n2.5,18.2\n60,50\n", encoding="utf-8")
    found = json.loads(run(folder, "--reference", folder / "radar.csv", "--json").stdout)["speeds"]
    assert (found["pairs"], found["unmatched_readings"]) == (2, 1)
    assert found["bias_kmh"] == pytest.approx(3.6 * 5.15 - 18.1)
    low, high = found["limits_of_agreement_kmh"]
    assert low < found["bias_kmh"] < high


def test_a_radar_keeps_to_the_course_and_the_lane_it_names(folder):
    document = json.loads((folder / "tracks.json").read_text(encoding="utf-8"))
    for track, course, lane in zip(document["tracks"], (90.0, 270.0), (1, 2), strict=True):
        track["summary"] |= {"direction": course, "lane": lane, "speed_ci95": [4.9, 5.3]}
    (folder / "tracks.json").write_text(json.dumps(document), encoding="utf-8")
    (folder / "radar.csv").write_text(
        "t,speed_kmh,direction,lane\n2,18.7,280,\n2,18.3,,1\n2,18,0,2\n", encoding="utf-8"
    )
    found = json.loads(run(folder, "--reference", folder / "radar.csv", "--json").stdout)["speeds"]
    assert (found["pairs"], found["unmatched_readings"], found["unmatched_tracks"]) == (2, 1, 0)
    assert found["worst_kmh"] < 0.1
    assert found["coverage_95"] == 1
    assert (folder / "evaluation.png").read_bytes().startswith(b"\x89PNG")


def test_by_itself_a_run_is_judged_by_its_innovations(folder):
    assert "no track carries its innovations" in run(folder).stdout
    document = json.loads((folder / "tracks.json").read_text(encoding="utf-8"))
    for track in document["tracks"]:
        track["summary"] |= {"nis_mean": 6.0, "nis_dof": 3}
    (folder / "tracks.json").write_text(json.dumps(document), encoding="utf-8")
    done = run(folder)
    assert "2.000 of 1" in done.stdout
    assert "too sure of itself" in done.stdout


def test_what_is_lost_and_found_again_is_one_fragment(folder):
    document = json.loads((folder / "tracks.json").read_text(encoding="utf-8"))
    del document["tracks"][0]["states"][10:20]
    (folder / "tracks.json").write_text(json.dumps(document), encoding="utf-8")
    found = json.loads(run(folder, "--truth", folder / "truth.csv", "--json").stdout)
    assert (found["missed"], found["fragments"], found["switches"]) == (10, 1, 0)
    assert found["mean_speed_m_s"]["tracks"] == 2
    assert found["mean_speed_m_s"]["bias"] == pytest.approx(0.15)
    if "mota" in found:
        assert found["mota"] == pytest.approx(found["moda"])
        assert found["idf1"] == pytest.approx(2 * 70 / 150)


def test_in_a_cameras_frame_the_ground_is_across_its_y_axis(folder):
    document = json.loads((folder / "tracks.json").read_text(encoding="utf-8"))
    document["frame_of_reference"] = "left-camera"
    for track in document["tracks"]:
        for state in track["states"]:
            (x, z), (vx, vz) = state["position"], state["velocity"]
            state |= {"position": [x, 7.0, z], "velocity": [vx, 0.0, vz], "covariance": np.eye(6).tolist()}
    (folder / "tracks.json").write_text(json.dumps(document), encoding="utf-8")
    rows = (folder / "truth.csv").read_text(encoding="utf-8").splitlines()[1:]
    cells = [row.split(",") for row in rows]
    swapped = [",".join([*c[:4], "0", c[4], c[6], "0", c[7]]) for c in cells]
    (folder / "camera.csv").write_text(HEADER + "\n".join(swapped) + "\n", encoding="utf-8")
    away = json.loads(run(folder, "--truth", folder / "camera.csv", "--json").stdout)
    near = json.loads(run(folder, "--truth", folder / "camera.csv", "--plane", "--json").stdout)
    assert (away["dimensions"], away["matched"]) == (3, 0)
    assert (near["dimensions"], near["matched"]) == (2, 80)
    assert near["position_m"]["rmse"] == pytest.approx(0.1 * np.sqrt(2), rel=0.2)
    assert near["velocity_m_s"]["rmse"] == pytest.approx(0.2 * np.sqrt(2), rel=0.2)


def test_of_several_clips_the_truth_must_name_its_own(folder):
    document = json.loads((folder / "tracks.json").read_text(encoding="utf-8"))
    for track, clip in zip(document["tracks"], ("a.mp4", "b.mp4"), strict=True):
        track["clip"] = clip
    (folder / "tracks.json").write_text(json.dumps(document), encoding="utf-8")
    done = run(folder, "--truth", folder / "truth.csv")
    assert done.returncode == 3
    assert "a column clip" in done.stderr
    rows = (folder / "truth.csv").read_text(encoding="utf-8").splitlines()
    named = ["clip," + rows[0], *(("b.mp4," if ",12," in row else "a.mp4,") + row for row in rows[1:])]
    (folder / "named.csv").write_text("\n".join(named) + "\n", encoding="utf-8")
    assert json.loads(run(folder, "--truth", folder / "named.csv", "--json").stdout)["matched"] == 80


@pytest.mark.parametrize(
    ("truth", "code", "fragment"),
    [
        ("", 3, "column frame is missing"),
        (HEADER, 3, "has no rows"),
        (HEADER + "0,0,1,a,0,,,,\n", 3, "line 2, column x: 'a' is not a number"),
        (HEADER.replace("y,", ""), 3, "column y is missing"),
        (HEADER + "0,0,1,,0,,,,\n", 3, "line 2, column x: is empty"),
        (HEADER + "0,0,1,nan,0,,,,\n", 3, "nan is not finite"),
        (HEADER + "0,0,1,1e300,0,,,,\n", 3, "not a place"),
        (HEADER + "\n0,0,1,1,0,,,,\n0,0,1,2,0,,,,\n", 3, "line 4: id 1 is in frame 0 already, by line 3"),
    ],
)
def test_bad_truth_is_refused_in_one_line(folder, truth, code, fragment):
    (folder / "bad.csv").write_text(truth, encoding="utf-8")
    done = run(folder, "--truth", folder / "bad.csv")
    assert done.returncode == code
    assert len(done.stderr.strip().splitlines()) == 1
    assert fragment in done.stderr


def test_a_folder_without_tracks_and_a_gate_of_nothing_are_refused(tmp_path, folder):
    done = run(tmp_path / "nowhere")
    assert done.returncode == 3
    assert "RUN is the folder of a run" in done.stderr
    for gate in (0, "nan", "inf"):
        assert run(folder, "--truth", folder / "truth.csv", "--gate", gate).returncode == 2
