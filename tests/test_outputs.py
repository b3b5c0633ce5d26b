"""Results out: whole or not at all, sorted, locked, and never over somebody else's files."""

import csv
import json
import os
import resource
import subprocess
import sys
from datetime import UTC, datetime

import av
import numpy as np
import pytest
from clips import pictures

from visfuse_cli.errors import BusyError, OutputError
from visfuse_cli.files import atomic
from visfuse_cli.files.run_json import write_run_json
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.spool import TrackSpool, write_table
from visfuse_cli.files.video import open_source
from visfuse_cli.files.video_writer import VideoWriter
from visfuse_cli.records import TimeAudit


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def small_disk():
    """No file may grow beyond 64 KiB: the write then fails as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (65536, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    target = tmp_path / "H.json"
    atomic.write_text(target, "old")
    with pytest.raises(ZeroDivisionError), atomic.replacing(target) as file:
        file.write(b"new %d" % (1 / 0))
    assert (target.read_text(), names(tmp_path)) == ("old", ["H.json"])
    with pytest.raises(ValueError, match="not JSON compliant"):
        atomic.write_json(target, {"speed": float("nan")})
    assert target.read_text() == "old"
    atomic.write_json(target, {"speed": 1.5, "name": "Straße"})
    assert json.loads(target.read_text("utf-8")) == {"speed": 1.5, "name": "Straße"}
    assert target.stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "real")
    atomic.write_text(tmp_path / "link", "text")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "text"


@pytest.mark.parametrize("target", ["folder", "nowhere/file", "file/below", "/dev/full", "/proc/visfuse"])
def test_what_cannot_be_written_is_an_output_error(target, tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(OutputError) as caught:
        atomic.write_text(tmp_path / target, "text")
    assert target in str(caught.value)
    assert names(tmp_path) == ["file", "folder"]


def write_noise(path):
    rng = np.random.default_rng(0)
    with VideoWriter(path, 320, 240) as video:
        for k in range(40):
            video.write(rng.integers(0, 255, (240, 320, 3)).astype(np.uint8), k / 25)


def write_tracks(folder, ids):
    with TrackSpool(folder, "speed", 0, "ground") as tracks:
        for k in ids:
            tracks.add({"id": k, "states": [0.5] * 1000})


@pytest.mark.usefixtures("small_disk")
def test_a_full_disk_leaves_nothing_behind(tmp_path):
    with pytest.raises(OutputError, match=r"big\.txt: cannot be written: File too large"):
        atomic.write_text(tmp_path / "big.txt", "x" * 100_000)
    with pytest.raises(OutputError, match=r"big\.mp4: cannot be written"):
        write_noise(tmp_path / "big.mp4")
    with pytest.raises(OutputError, match="cannot be written"):
        write_tracks(tmp_path, range(100))
    assert names(tmp_path) == []


@pytest.mark.parametrize("size", [(64, 48), (63, 47)])
def test_video_keeps_times_and_pictures(size, tmp_path):
    images = pictures(9, *size)
    times = [0.0, 0.04, 0.11, 0.12, 0.5, 0.9, 1.0, 1.5, 4.0]
    with VideoWriter(tmp_path / "a.mp4", *size) as video:
        for image, t in zip(images, times, strict=True):
            video.write(image, t)
    assert names(tmp_path) == ["a.mp4"]
    with open_source(tmp_path / "a.mp4") as source:
        frames = list(source.frames())
    assert [f.t for f in frames] == pytest.approx(times, abs=1e-9)
    assert (source.width, source.height) == (64, 48)
    for frame, image in zip(frames, images, strict=True):
        assert np.abs(frame.image[: size[1], : size[0]].astype(int) - image).mean() < 4
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # plays before it is whole


def test_video_of_a_broken_run_goes_of_an_interrupted_one_stays(tmp_path):
    def record(problem):
        with VideoWriter(tmp_path / "a.mp4", 64, 48) as video:
            video.write(pictures(1)[0], 0.0)
            raise problem

    with pytest.raises(RuntimeError):
        record(RuntimeError())
    assert names(tmp_path) == []
    with pytest.raises(KeyboardInterrupt):
        record(KeyboardInterrupt())
    with open_source(tmp_path / "a.mp4") as source:
        assert len(list(source.frames())) == 1
    with VideoWriter(tmp_path / "none.mp4", 64, 48):
        pass
    assert names(tmp_path) == ["a.mp4"]


def test_video_refuses_times_that_do_not_rise_and_other_sizes(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", 64, 48) as video:
        video.write(pictures(1)[0], 1.0)
        with pytest.raises(ValueError, match="does not come after"):
            video.write(pictures(1)[0], 1.0)
        with pytest.raises(ValueError, match="was announced"):
            video.write(pictures(1, 32, 48)[0], 2.0)


def test_run_folder_refuses_what_it_may_not_touch(tmp_path):
    out = tmp_path / "deep" / "run"
    with RunFolder(out) as folder:
        (folder / "tracks.json").write_text("{}")
        (folder / "annotated-left.mp4").touch()
        (folder / "mine.txt").touch()
        with pytest.raises(BusyError, match="another run holds"), RunFolder(out, overwrite=True):
            pass
    assert names(out) == ["annotated-left.mp4", "mine.txt", "tracks.json"]
    with pytest.raises(OutputError, match=r"not empty.*--overwrite"), RunFolder(out):
        pass
    assert names(out) == ["annotated-left.mp4", "mine.txt", "tracks.json"]
    with RunFolder(out, overwrite=True) as folder:
        assert names(folder) == [".visfuse.lock", "mine.txt"]
    (tmp_path / "file").touch()
    for name in ("file", "file/below"):
        with pytest.raises(OutputError, match="file"), RunFolder(tmp_path / name):
            pass


def test_run_folder_goes_again_when_the_run_fails_at_once(tmp_path):
    with pytest.raises(RuntimeError), RunFolder(tmp_path / "run"):
        raise RuntimeError
    assert names(tmp_path) == []


def test_a_killed_run_can_be_repeated(tmp_path):
    script = f"""
import os, signal
from pathlib import Path
from visfuse_cli.files.runfolder import RunFolder
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video_writer import VideoWriter
with RunFolder({str(tmp_path / "run")!r}) as folder, TrackSpool(folder, "speed", 0, "ground") as tracks:
    with VideoWriter(folder / "annotated.mp4", 64, 48) as video:
        tracks.add({{"id": 1}})
        os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == -9
    assert len(names(tmp_path / "run")) == 3
    with RunFolder(tmp_path / "run") as folder:
        assert names(folder) == [".visfuse.lock"]


def test_tracks_are_sorted_rounded_and_the_same_every_time(tmp_path):
    tracks = [
        {
            "id": k,
            "states": [
                {
                    "t": 0.1 + 0.2,
                    "position": np.array([5673100.123456789, -0.0]),
                    "covariance": [[1 / 3]],
                    "measured": np.bool_(True),
                    "n": np.int64(3),
                }
            ],
        }
        for k in (10, 2, 7)
    ]
    for name, order in (("a", tracks), ("b", tracks[::-1])):
        (tmp_path / name).mkdir()
        with TrackSpool(tmp_path / name, "speed", 3, "ground") as spool:
            for track in order:
                spool.add(track)
            assert len(spool) == 3
        assert names(tmp_path / name) == ["tracks.json"]
    assert (tmp_path / "a" / "tracks.json").read_bytes() == (tmp_path / "b" / "tracks.json").read_bytes()
    document = json.loads((tmp_path / "a" / "tracks.json").read_text())
    assert {k: v for k, v in document.items() if k != "tracks"} == {
        "schema": "visfuse.tracks/1", "command": "speed", "seed": 3, "frame_of_reference": "ground"
    }  # fmt: skip
    assert [track["id"] for track in document["tracks"]] == [2, 7, 10]
    state = document["tracks"][0]["states"][0]
    assert state == {
        "t": 0.3, "position": [5673100.12346, 0.0], "covariance": [[0.333333333]], "measured": True, "n": 3
    }  # fmt: skip


def test_tracks_of_a_broken_run_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"), TrackSpool(tmp_path, "speed", 0, "ground") as spool:
        spool.add({"id": 1, "speed": float("nan")})
    with pytest.raises(ValueError, match="two tracks have the id 1"):
        write_tracks(tmp_path, (1, 1))
    assert names(tmp_path) == []
    with TrackSpool(tmp_path, "speed", 0, "ground"):
        pass
    assert json.loads((tmp_path / "tracks.json").read_text())["tracks"] == []


def test_table_is_sorted_by_clip_time_and_id(tmp_path):
    rows = [
        {"clip": "b", "t_start": "1.0", "track_id": 1, "lane": None},
        {"clip": "a", "t_start": "10.0", "track_id": 2},
        {"clip": "a", "t_start": "9.5", "track_id": 12, "lane": "x, y"},
        {"clip": "a", "t_start": "9.5", "track_id": 3},
        {"clip": "a", "t_start": "9.5", "track_id": ""},
    ]
    write_table(tmp_path / "t.csv", ["clip", "track_id", "t_start", "lane"], rows)
    with open(tmp_path / "t.csv", newline="") as file:
        read = list(csv.DictReader(file))
    assert [(r["clip"], r["track_id"], r["lane"]) for r in read] == [
        ("a", "3", ""), ("a", "12", "x, y"), ("a", "", ""), ("a", "2", ""), ("b", "1", "")
    ]  # fmt: skip
    assert b"\r" not in (tmp_path / "t.csv").read_bytes()


def test_run_json_says_what_ran(tmp_path):
    write_run_json(
        tmp_path / "run.json",
        command="speed",
        argv=("visfuse", "speed"),
        config={"video": {"fps": None}},
        inputs=[{"path": "a.mp4", "size": 1, "sha256": "00"}],
        seed=4,
        started=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC),
        audits={"image": TimeAudit(10, 0.9, 0.1, 0, 0, 0, 0)},
        warnings=["w"],
        counts={"tracks": 2},
        stages={"decode": 0.12345},
        extra={"gate": 1},
    )
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["schema"] == "visfuse.run/1"
    assert run["started"] == "2026-01-02T03:04:05Z"
    assert run["time_audit"]["image"]["frames"] == 10
    assert run["versions"].keys() == {"python", "platform", "numpy", "opencv", "av"}
    assert (run["seconds_per_stage"], run["gate"], run["stopped_by"]) == ({"decode": 0.123}, 1, None)
