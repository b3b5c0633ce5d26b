"""What a hostile user finds: inputs in the way of results, odd names and sizes, full outputs, early ends."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import pytest

from visfuse_cli.commands.speed import SpeedConfig
from visfuse_cli.config import load
from visfuse_cli.errors import InputError, OutputError, UsageError
from visfuse_cli.files.folders import describe
from visfuse_cli.files.homography import read
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.traffic_log import read as read_log

pytestmark = pytest.mark.contract
SAMPLE = Path(str(resources.files("visfuse_cli.apps.sample")))
SHORT = ("--end", "0.2", "--no-video", "--no-report")


def run(*args, **more):
    command = [sys.executable, "-m", "visfuse_cli", *args]
    return subprocess.run(command, capture_output=True, timeout=600, **more)


@pytest.fixture(scope="module")
def H(tmp_path_factory):
    path = tmp_path_factory.mktemp("H") / "H.json"
    assert run("calibrate-homography", "--points", SAMPLE / "points.csv", "--out", path, "-q").returncode == 0
    return path


@pytest.mark.parametrize("name", ["tracks.json", "annotated-x.mp4", "map.png"])
def test_an_input_is_never_lost_to_results(name, tmp_path):
    (tmp_path / name).write_text("mine")
    (tmp_path / "speeds.csv").write_text("of an earlier run")
    with pytest.raises(OutputError, match="is an input"), RunFolder(tmp_path, True, inputs=[tmp_path / name]):
        pass
    assert {path.name for path in tmp_path.iterdir()} == {name, "speeds.csv"}
    with pytest.raises(OutputError, match="is an input"), RunFolder(tmp_path, True, inputs=[tmp_path]):
        pass
    with RunFolder(tmp_path, True, inputs=[tmp_path / "elsewhere" / name]):
        pass
    assert not list(tmp_path.iterdir())


def test_a_name_of_any_bytes_is_measured_and_logged(H, tmp_path):
    clips = tmp_path / "clips"
    clips.mkdir()
    clip = os.fsencode(clips) + b"/new\n'\"line \xff.mp4"
    shutil.copy(SAMPLE / "clip.mp4", clip)
    os.utime(clip, (1, 1))
    log = tmp_path / "s.sqlite"
    done = run("speed", clips, "--homography", H, "--log", log, "--new-only", *SHORT, "-q", "--out", tmp_path / "o")
    assert (done.returncode, done.stderr) == (0, b""), done.stderr
    assert [each["name"] for each in read_log(log)[0]] == ["new\n'\"line \\udcff.mp4"]
    done = run("speed", clip, "--homography", H, "--out", tmp_path / "one", "--json", *SHORT)
    assert done.returncode == 0, done.stderr
    with open(tmp_path / "one" / "speeds.csv", newline="") as file:
        assert next(csv.reader(file))[0] == "clip"


@pytest.mark.parametrize(("size", "code"), [((8, 8), 0), ((300, 9), 0), ((7, 400), 3)])
def test_small_pictures(size, code, H, tmp_path):
    (tmp_path / "images").mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"{k}.png"), np.full((*size[::-1], 3), 40 * k, np.uint8))
    done = run(
        *("speed", tmp_path / "images", "--homography", H, "--out", tmp_path / "o", *SHORT, "--set", "video.fps=9")
    )
    assert done.returncode == code, done.stderr
    assert b"internal" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("args", [("--version",), ("config", "show", "speed")])
def test_a_full_device_as_output_is_said(args):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "visfuse_cli", *args]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert (done.returncode, len(done.stderr.splitlines())) == (4, 1), done.stderr
    assert "No space left" in done.stderr


def test_a_run_without_a_terminal_at_all(H, tmp_path):
    command = f'exec "$0" -m visfuse_cli speed {SAMPLE / "clip.mp4"} --homography {H} --out {tmp_path / "o"} "$@"'
    done = subprocess.run(["sh", "-c", f"{command} <&- >&- 2>&-", sys.executable, *SHORT], timeout=600)
    assert done.returncode == 0
    assert (tmp_path / "o" / "run.json").exists()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_end_before_the_first_frame_has_the_same_code(number, code, H, tmp_path):
    fifo = tmp_path / "slow.json"
    os.mkfifo(fifo)  # the run waits for its homography
    command = [sys.executable, "-m", "visfuse_cli", "speed", SAMPLE / "clip.mp4", "--homography", fifo]
    running = subprocess.Popen([*command, "--out", tmp_path / "o"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    with open(fifo, "w"):  # returns as soon as the run opens it
        time.sleep(0.1)
        running.send_signal(number)
        _, errors = running.communicate(timeout=60)  # it waits on: only the signal ends it
    assert running.returncode == code, errors
    assert len(errors.splitlines()) <= 1
    assert b"Traceback" not in errors
    assert not (tmp_path / "o").exists()


def test_what_is_no_file_is_not_read_to_its_end(H):
    with pytest.raises(InputError, match="is not a file"):
        describe("/dev/zero")
    with pytest.raises(UsageError, match="larger than"):
        load(SpeedConfig, "/dev/zero")


def test_a_time_pattern_needs_no_quotes():
    assert load(SpeedConfig, None, ["clock.pattern=%Y%m%d-%H%M%S"]).clock.pattern == "%Y%m%d-%H%M%S"


@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_a_homography_of_another_scale_is_refused(scale, H, tmp_path):
    document = json.loads(H.read_text())
    document["H"] = (np.array(document["H"]) * scale).tolist()
    (tmp_path / "H.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="must be scaled"):
        read(tmp_path / "H.json")
