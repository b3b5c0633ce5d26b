"""`--rerun`: what the viewer gets is the run, with cameras that see the tracks where their boxes are."""

import json
import subprocess
import sys
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from visfuse_cli.apps import rerun_log
from visfuse_cli.commands.speed import SpeedConfig
from visfuse_cli.errors import OutputError, UsageError
from visfuse_cli.records import RunRequest

SAMPLE = Path(str(resources.files("visfuse_cli.apps.sample")))
pytest.importorskip("rerun", reason="rerun-sdk is not installed")


def visfuse(*args: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "visfuse_cli", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_a_recording_holds_frames_boxes_tracks_covariances_and_cameras(tmp_path: Path):
    H, out, file = tmp_path / "H.json", tmp_path / "run", tmp_path / "run.rrd"
    visfuse("calibrate-homography", "--points", SAMPLE / "points.csv", "--size", "960x540", "--out", H)
    short = ("--end", "2", "--no-video", "--no-report")
    done = visfuse("speed", SAMPLE / "clip.mp4", "--homography", H, "--out", out, *short, "--rerun", file)
    assert done.returncode == 0, done.stderr
    tracks = json.loads((out / "tracks.json").read_text())["tracks"]
    assert tracks
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(file)]
    told = subprocess.run(command, capture_output=True, text=True, timeout=60).stdout
    places = ["cameras/image/picture", "cameras/image/boxes"]
    places += [f"tracks/{track['id']}/{part}" for track in tracks for part in ("way", "point", "covariance")]
    for place in places:
        assert f"/world/{place}" in told, place
    assert [path.name for path in tmp_path.iterdir() if path.name.endswith(".partial")] == []
    see(RunRequest("speed", SAMPLE / "clip.mp4", out, SpeedConfig(), {"homography": H}), tracks)
    again = visfuse("speed", SAMPLE / "clip.mp4", "--homography", H, "--out", tmp_path / "b", *short, "--rerun", file)
    assert again.returncode == 4
    assert not (tmp_path / "b").exists()


def see(request: RunRequest, tracks: list) -> None:
    """The footprint of a vehicle seen whole lies in the lower half of its box, by the camera that the viewer gets."""
    from visfuse_cli.apps.rerun_log.scenes import scene_of

    [eye] = scene_of(request, request.out).eyes
    R, T = eye.pose(0)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) > 0
    places = []
    for state in (state for track in tracks for state in track["states"]):
        u, v, w = eye.K @ R.T @ (np.array([*state["position"], 0.0]) - T)
        x, y, wide, high = state["box"]["image"]
        if x > 2 and y > 2 and x + wide < eye.size[0] - 2 and y + high < eye.size[1] - 2:
            places.append([(u / w - x) / wide, (v / w - y) / high])
    across, down = np.median(places, axis=0)
    assert 0.3 < across < 0.7
    assert 0.5 < down < 1.0


@pytest.mark.parametrize("size", [2, 3])
def test_ellipsoids_are_those_of_the_covariances(size: int):
    from visfuse_cli.apps.rerun_log.write import _ellipsoids

    root = np.random.default_rng(1).normal(size=(5, size, size))
    cov = root @ root.transpose(0, 2, 1) + np.eye(size)
    half, quaternions = _ellipsoids(cov)
    R = Rotation.from_quat(quaternions).as_matrix()
    back = R @ (half[:, :, None] ** 2 * R.transpose(0, 2, 1)) / chi2.ppf(0.95, size)
    np.testing.assert_allclose(back[:, :size, :size], cov, atol=1e-9)


def test_a_file_that_could_not_be_written_is_told_before_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    request = RunRequest("speed", SAMPLE / "clip.mp4", tmp_path / "run", SpeedConfig(), {"homography": None})
    with pytest.raises(UsageError, match=r"ends in \.rrd"):
        rerun_log.check(request, tmp_path / "run.txt")
    with pytest.raises(OutputError, match="there is no folder"):
        rerun_log.check(request, tmp_path / "no" / "run.rrd")
    rerun_log.check(request, tmp_path / "run" / "run.rrd")  # the run makes its folder
    monkeypatch.setattr(rerun_log, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"visfuse-cli\[rerun\]"):
        rerun_log.check(request, tmp_path / "run.rrd")
