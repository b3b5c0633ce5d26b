"""Bad input of every kind: the right exit code, one clear line, nothing written under a final name."""

import fcntl
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from samples.files import write_scene
from samples.road import free_flow

pytestmark = pytest.mark.contract
POINTS = "u,v,X,Y\n100,300,0,0\n400,310,6,0\n120,150,0,12\n300,155,6,12\n210,200,3,6\n"
CLIP, H = "{clip}", "{H}"


@pytest.fixture(scope="module")
def ready(tmp_path_factory):
    """A small good scene, its homography, and a folder to put bad things in."""
    folder = tmp_path_factory.mktemp("ready")
    write_scene(free_flow(3, 3, size=(480, 270)), folder)
    done = run(
        "calibrate-homography", "--points", folder / "points.csv", "--size", "480x270", "--out", folder / "H.json"
    )
    assert done.returncode == 0, done.stderr
    return folder


def run(*args, **more):
    command = [sys.executable, "-m", "visfuse_cli", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **more)


def refused(done, code, fragment):
    lines = done.stderr.strip().splitlines()
    assert done.returncode == code, done.stderr
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("visfuse: ")
    assert fragment in lines[0], lines[0]
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


BAD_POINTS = {
    "empty": (b"", "is empty"),
    "header only": (b"u,v,X,Y\n", "no rows"),
    "binary": (bytes(range(128, 256)) * 20, "not a text file"),
    "missing column": (b"u,v,X\n1,2,3\n", "column Y is missing"),
    "twin column": (b"u,v,X,Y,u\n1,2,3,4,5\n", "u is given twice"),
    "word": (POINTS.replace("310", "abc").encode(), "line 3, column v: 'abc' is not a number"),
    "nan": (POINTS.replace("310", "nan").encode(), "line 3, column v"),
    "infinite": (POINTS.replace("310", "inf").encode(), "not a finite number"),
    "short row": (POINTS.replace("400,310,6,0", "400,310,6").encode(), "line 3"),
    "three": ("\n".join(POINTS.splitlines()[:4]).encode(), "four"),
    "collinear": (b"u,v,X,Y\n0,0,0,0\n10,10,1,1\n20,20,2,2\n30,30,3,3\n40,40,4,4\n", "line"),
    "same point": (POINTS.replace("400,310,6,0", "100,300,0,0").encode(), "same"),
}


@pytest.mark.parametrize("kind", BAD_POINTS)
def test_bad_points(kind, tmp_path):
    content, fragment = BAD_POINTS[kind]
    (tmp_path / "points.csv").write_bytes(content)
    refused(run("calibrate-homography", "--points", tmp_path / "points.csv", "--out", tmp_path / "H.json"), 3, fragment)
    assert not (tmp_path / "H.json").exists()


def test_missing_points_file(tmp_path):
    refused(run("calibrate-homography", "--points", tmp_path / "no.csv", "--out", tmp_path / "H.json"), 3, "no.csv")


def test_sizes_that_disagree(tmp_path):
    (tmp_path / "points.csv").write_text(POINTS)
    cv2.imwrite(str(tmp_path / "frame.png"), np.zeros((360, 640, 3), np.uint8))
    options = ("--points", tmp_path / "points.csv", "--image", tmp_path / "frame.png", "--size", "800x600")
    refused(run("calibrate-homography", *options, "--out", tmp_path / "H.json"), 3, "640x360")


COMMAND_LINES = {
    "unknown command": (("sped",), 2, "sped"),
    "unknown option": (("speed", "clip.mp4", "--homografy", "H.json"), 2, "homografy"),
    "missing option": (("speed", "clip.mp4", "--out", "run"), 2, "homography"),
    "two sources": (("calibrate-homography", "--points", "a", "--lines", "b", "--out", "H.json"), 2, "exactly one"),
    "bad size": (("calibrate-homography", "--points", "a", "--size", "big", "--out", "H.json"), 2, "WIDTHxHEIGHT"),
    "unknown key": (("config", "show", "speed", "--set", "filter.kinds=ekf"), 2, "did you mean 'kind'"),
    "wrong type": (("config", "show", "speed", "--set", "filter.sigma_a=fast"), 2, "filter.sigma_a"),
    "out of range": (("config", "show", "speed", "--set", "filter.sigma_a=-1"), 2, "greater than 0"),
    "no value": (("config", "show", "speed", "--set", "filter.kind"), 2, "a.b.c=VALUE"),
    "unknown config": (("config", "show", "speed", "trafic"), 2, "did you mean 'traffic'"),
    "config of no command": (("config", "show", "sped"), 2, "did you mean 'speed'"),
}


@pytest.mark.parametrize("kind", COMMAND_LINES)
def test_bad_command_line(kind, tmp_path):
    arguments, code, fragment = COMMAND_LINES[kind]
    refused(run(*arguments, cwd=tmp_path), code, fragment)


HOSTILE_YAML = {
    "alias bomb": ("a: &a [x, x]\nb: [*a, *a]\n", "aliases"),
    "python object": ("filter: !!python/object/apply:os.system ['true']\n", "not valid YAML"),
    "deep": ("[" * 5000 + "]" * 5000, "not valid YAML"),
    "twin key": ("filter: {kind: ekf}\nfilter: {kind: fading}\n", "given twice"),
    "tabs": ("filter:\n\tkind: ekf\n", "line 2"),
    "a list": ("- 1\n- 2\n", "mapping"),
    "word for a number": ("speed:\n  min_frames: many\n", "line 2"),
}


@pytest.mark.parametrize("kind", HOSTILE_YAML)
def test_hostile_configuration(kind, tmp_path):
    text, fragment = HOSTILE_YAML[kind]
    (tmp_path / "bad.yaml").write_text(text)
    refused(run("config", "check", "speed", tmp_path / "bad.yaml"), 2, fragment)


def homography(ready, tmp_path, old="", new=""):
    text = (ready / "H.json").read_text()
    path = tmp_path / "H.json"
    path.write_text(text.replace(old, new, 1) if old else new)
    return path


BAD_HOMOGRAPHY = {
    "not json": ("", "{", "not JSON"),
    "wrong schema": ("visfuse.homography/1", "something/2", "schema"),
    "gaze": ('"input": "pixel"', '"input": "gaze"', "gaze"),
    "no covariance": ('"covariance"', '"kovarianz"', "covariance"),
    "another size": ("480", "640", "480x270"),
}


@pytest.mark.parametrize("kind", BAD_HOMOGRAPHY)
def test_bad_homography(kind, ready, tmp_path):
    old, new, fragment = BAD_HOMOGRAPHY[kind]
    path = homography(ready, tmp_path, old, new)
    refused(run("speed", ready / "clip.mp4", "--homography", path, "--out", tmp_path / "run"), 3, fragment)
    assert not (tmp_path / "run").exists()


def folder_of(tmp_path, sizes, stamps=None):
    folder = tmp_path / "images"
    folder.mkdir()
    for k, size in enumerate(sizes):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((*size[::-1], 3), 10 * k, np.uint8))
    if stamps is not None:
        (folder / "timestamps.csv").write_text(stamps)
    return folder


def bad_clip(kind, tmp_path):
    path = tmp_path / "clip.mp4"
    if kind == "text":
        path.write_text("this is no video\n" * 50)
    elif kind == "zero bytes":
        path.write_bytes(b"")
    elif kind == "empty folder":
        (tmp_path / "clip.mp4").mkdir()
    elif kind == "no times":
        return folder_of(tmp_path, [(480, 270)] * 3)
    elif kind == "unsorted times":
        return folder_of(tmp_path, [(480, 270)] * 3, "frame,t\n0,0\n1,0.2\n2,0.1\n")
    elif kind == "nan time":
        return folder_of(tmp_path, [(480, 270)] * 3, "frame,t\n0,0\n1,nan\n2,0.1\n")
    elif kind == "two sizes":
        return folder_of(tmp_path, [(480, 270), (480, 270), (640, 360)], "frame,t\n0,0\n1,0.1\n2,0.2\n")
    return path


BAD_CLIPS = {
    "missing": "clip.mp4",
    "text": "clip.mp4",
    "zero bytes": "clip.mp4",
    "empty folder": "clip.mp4",
    "no times": "video.fps",
    "unsorted times": "timestamps.csv",
    "nan time": "timestamps.csv",
    "two sizes": "2.png",
}


@pytest.mark.parametrize("kind", BAD_CLIPS)
def test_bad_footage(kind, ready, tmp_path):
    done = run("speed", bad_clip(kind, tmp_path), "--homography", ready / "H.json", "--out", tmp_path / "run", "-q")
    refused(done, 3, BAD_CLIPS[kind])
    assert not list((tmp_path / "run").glob("*")) if (tmp_path / "run").exists() else True


def test_truncated_clip_yields_its_readable_part(ready, tmp_path):
    whole = ready / "clip.mp4"
    cut = tmp_path / "cut.ts"
    subprocess_free_remux(whole, cut)
    data = cut.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    done = run("speed", cut, "--homography", ready / "H.json", "--out", tmp_path / "run", "--no-video")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "speeds.csv").exists()


def subprocess_free_remux(source, target):
    import av

    with av.open(str(source)) as inside, av.open(str(target), "w", format="mpegts") as outside:
        stream = outside.add_stream_from_template(inside.streams.video[0])
        for packet in inside.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                outside.mux(packet)


@pytest.mark.parametrize(
    ("row", "fragment"),
    [
        ("1,-1,5,5,ten,10,1", "column w"),
        ("0,-1,5,5,10,10,1", "from 1 on"),
        ("1,-1,5,5,0,10,1", "positive"),
        ("1,2,3", "columns"),
    ],
)
def test_bad_detections(row, fragment, ready, tmp_path):
    (tmp_path / "boxes.txt").write_text(f"1,-1,5,5,10,10,1\n{row}\n")
    options = ("--homography", ready / "H.json", "--detections", tmp_path / "boxes.txt", "--out", tmp_path / "run")
    done = run("speed", ready / "clip.mp4", *options)
    refused(done, 3, "line 2")
    assert fragment in done.stderr


@pytest.mark.parametrize(
    ("options", "code", "fragment"),
    [
        (("--start", "2", "--end", "1"), 2, "--start"),
        (("--start", "-1"), 2, "--start"),
        (("--start", "100"), 3, "ends before"),
    ],
)
def test_bad_times(options, code, fragment, ready, tmp_path):
    done = run("speed", ready / "clip.mp4", "--homography", ready / "H.json", "--out", tmp_path / "run", *options)
    refused(done, code, fragment)


def test_output_is_not_empty(ready, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("keep me")
    options = ("--homography", ready / "H.json", "--out", tmp_path / "run", "--no-video")
    refused(run("speed", ready / "clip.mp4", *options), 4, "--overwrite")
    assert run("speed", ready / "clip.mp4", *options, "--overwrite").returncode == 0
    assert (tmp_path / "run" / "mine.txt").read_text() == "keep me"


def test_output_is_a_file(ready, tmp_path):
    (tmp_path / "run").write_text("a file")
    options = ("--homography", ready / "H.json", "--out")
    refused(run("speed", ready / "clip.mp4", *options, tmp_path / "run"), 4, "is a file")
    refused(run("speed", ready / "clip.mp4", *options, tmp_path / "run" / "deeper"), 4, "cannot be written")


def test_disk_full(ready, tmp_path):
    def no_room():
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    options = ("--homography", ready / "H.json", "--out", tmp_path / "run", "-q")
    done = run("speed", ready / "clip.mp4", *options, preexec_fn=no_room)
    refused(done, 4, "cannot be written")
    left = {p.name for p in (tmp_path / "run").iterdir()} if (tmp_path / "run").exists() else set()
    assert "tracks.json" not in left
    assert "annotated.mp4" not in left


def test_another_run_holds_the_output(ready, tmp_path):
    (tmp_path / "run").mkdir()
    with open(tmp_path / "run" / ".visfuse.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        refused(
            run("speed", ready / "clip.mp4", "--homography", ready / "H.json", "--out", tmp_path / "run"),
            75,
            "another run",
        )


@pytest.fixture
def long_run(ready, tmp_path):
    """A run that is in the middle of its work: enough clips to be caught at it."""
    clips = tmp_path / "clips"
    clips.mkdir()
    for k in range(12):
        os.link(ready / "clip.mp4", clips / f"{k:02}.mp4")
    command = [
        sys.executable,
        "-m",
        "visfuse_cli",
        "speed",
        clips,
        "--homography",
        ready / "H.json",
        "--out",
        tmp_path / "run",
    ]
    running = subprocess.Popen(
        [*map(str, command), "--no-video"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60
    while not list((tmp_path / "run").glob(".tracks*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.5)
    yield running, command, tmp_path / "run"
    running.kill()
    running.wait()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_leaves_readable_outputs(number, code, long_run):
    running, _, out = long_run
    running.send_signal(number)
    _, errors = running.communicate(timeout=60)
    assert running.returncode == code, errors
    assert "Traceback" not in errors
    names = {p.name for p in Path(out).iterdir()}
    assert {"tracks.json", "speeds.csv", "rejected.csv", "run.json"} <= names
    assert not [name for name in names if "partial" in name]


def test_killed_run_can_be_repeated(long_run, ready):
    running, _, out = long_run
    running.kill()
    running.wait()
    assert not (out / "tracks.json").exists()
    done = run("speed", ready / "clip.mp4", "--homography", ready / "H.json", "--out", out, "--no-video")
    assert done.returncode == 0, done.stderr
    assert (out / "tracks.json").exists()
