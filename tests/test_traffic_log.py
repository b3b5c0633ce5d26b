"""The traffic log: each recording once and whole, whoever writes; and what the summary makes of it."""

import csv
import hashlib
import json
import os
import shutil
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from visfuse_cli.apps.summary import as_text, summarise
from visfuse_cli.errors import InputError, OutputError, UsageError
from visfuse_cli.files.traffic_log import APPLICATION, MIGRATIONS, VERSION, LoggedClip, TrafficLog, read
from visfuse_cli.files.wall_clock import began, check_pattern
from visfuse_cli.maths.percentiles import pace, percentile

SAMPLE = Path(str(resources.files("visfuse_cli.apps.sample")))


def _clip(number=0, began_utc="2026-03-01T06:00:00Z", settings="a"):
    return LoggedClip(f"sha{number}", settings, f"clip{number}.mp4", began_utc, 60.0, 1500, "1.0")


def _rows(speeds, hour=6, lane=1):
    return [
        {
            "track_id": k,
            "t_start": k,
            "t_end": k + 1,
            "time_utc": f"2026-03-01T{hour:02d}:00:{k:02d}.000Z",
            "direction": 90.0 if k % 2 else 272.0,
            "lane": lane,
            "speed_kmh": speed,
            "ci95_low_kmh": speed - 1,
            "ci95_high_kmh": speed + 1,
            "distance_m": 20.0,
            "n_frames": 25,
        }
        for k, speed in enumerate(speeds)
    ]


def test_a_recording_is_added_once(tmp_path):
    with TrafficLog(tmp_path / "s.sqlite") as log:
        assert log.add(_clip(), _rows([50, 60]))
        assert not log.add(_clip(), _rows([70, 80]))
        assert log.holds("sha0", "a")
        assert not log.holds("sha0", "b")
    clips, vehicles = read(tmp_path / "s.sqlite")
    assert [clip["name"] for clip in clips] == ["clip0.mp4"]
    assert [row["speed_kmh"] for row in vehicles] == [50, 60]


def test_a_recording_measured_anew_counts_once_with_its_last_settings(tmp_path):
    with TrafficLog(tmp_path / "s.sqlite") as log:
        log.add(_clip(settings="a"), _rows([50]))
        log.add(_clip(settings="b"), _rows([51, 61]))
    assert [row["speed_kmh"] for row in read(tmp_path / "s.sqlite")[1]] == [51, 61]


def test_a_recording_is_added_whole_or_not_at_all(tmp_path):
    with TrafficLog(tmp_path / "s.sqlite") as log:
        with pytest.raises(OutputError):
            log.add(_clip(), [*_rows([50]), *_rows([60])])  # the same track_id twice
        assert not log.holds("sha0", "a")
        assert log.add(_clip(), _rows([50]))


def test_several_writers_share_a_log(tmp_path):
    def write(number):
        with TrafficLog(tmp_path / "s.sqlite") as log:
            return log.add(_clip(number % 10), _rows([50 + number % 10]))

    with ThreadPoolExecutor(8) as pool:
        added = list(pool.map(write, range(40)))
    assert sum(added) == 10
    assert [row["speed_kmh"] for row in read(tmp_path / "s.sqlite")[1]] == list(range(50, 60))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: path.write_text("track_id,speed\n" * 200), "not a traffic log"),
        (lambda path: sqlite3.connect(path).execute("CREATE TABLE a (b)").connection.commit(), "not a traffic log of"),
        (lambda path: _versioned(path, 99), "written by a newer visfuse"),
        (lambda path: None, "there is no such log"),
    ],
)
def test_what_is_no_log_is_refused(tmp_path, make, message):
    make(tmp_path / "s.sqlite")
    with pytest.raises(InputError, match=message):
        read(tmp_path / "s.sqlite")
    if (tmp_path / "s.sqlite").exists():
        with pytest.raises(InputError, match=message), TrafficLog(tmp_path / "s.sqlite"):
            pass


def _versioned(path, version):
    base = sqlite3.connect(path)
    base.execute("CREATE TABLE clips (id)")
    base.execute(f"PRAGMA application_id = {APPLICATION}")
    base.execute(f"PRAGMA user_version = {version}")
    base.commit()
    base.close()


def test_names_and_zones_tell_the_time():
    moment, _ = began(Path("cam1_20260701-101500.mp4"), "cam1_%Y%m%d-%H%M%S", "Europe/Vienna", None)
    assert moment.isoformat() == "2026-07-01T08:15:00+00:00"
    moment, _ = began(Path("2026-07-01T10.15.00+0530.mkv"), "%Y-%m-%dT%H.%M.%S%z", "Europe/Vienna", None)
    assert moment.isoformat() == "2026-07-01T04:45:00+00:00"
    assert began(Path("a.mp4"), None, "UTC", moment) == (moment, "")
    with pytest.raises(InputError, match=r"the name 'a' does not fit clock\.pattern"):
        began(Path("a.mp4"), "%Y%m%d%H", "UTC", None)
    with pytest.raises(InputError, match="does not fit"):
        began(Path("00010101-00.mp4"), "%Y%m%d-%H", "Europe/Vienna", None)  # before year 1 in UTC


CHANGES = {  # name in Vienna, the container's time -> UTC, what is doubtful
    "before": ("20261025-013000", None, "2026-10-24T23:30:00", ""),
    "twice": ("20261025-023000", None, "2026-10-25T00:30:00", "was twice"),
    "twice, the container knows": ("20261025-023000", "2026-10-25T01:31:00", "2026-10-25T01:30:00", ""),
    "twice, the container is elsewhere": ("20261025-023000", "2026-10-25T05:00:00", "2026-10-25T00:30:00", "was twice"),
    "after": ("20261025-033000", None, "2026-10-25T02:30:00", ""),
    "never": ("20260329-023000", None, "2026-03-29T01:30:00", "never was"),
    "spring": ("20260329-033000", None, "2026-03-29T01:30:00", ""),
}


@pytest.mark.parametrize("kind", CHANGES)
def test_hours_that_clocks_repeat_or_skip(kind):
    name, container, expected, doubtful = CHANGES[kind]
    recorded = None if container is None else datetime.fromisoformat(container).replace(tzinfo=UTC)
    moment, doubt = began(Path(f"{name}.mp4"), "%Y%m%d-%H%M%S", "Europe/Vienna", recorded)
    assert moment == datetime.fromisoformat(expected).replace(tzinfo=UTC)
    assert doubtful in doubt
    assert bool(doubtful) == bool(doubt)


@pytest.mark.parametrize("pattern", ["%Y%m%d-%H%M%S", "cam%%1_%y%j%H%M", "%Y-%m-%dT%H%M%S%z", "%d.%m.%y %I %p"])
def test_good_clock_patterns(pattern):
    check_pattern(pattern)


@pytest.mark.parametrize("pattern", ["%", "%s", "%Y%Y", "cam", "%Y-%m-%d", "%H%M", "%Y%m%d_%I%M"])
def test_bad_clock_patterns(pattern):
    with pytest.raises(ValueError, match=r"no time pattern|does not tell"):
        check_pattern(pattern)


@pytest.mark.parametrize("share", [0.5, 0.85])
def test_percentile_intervals_cover_what_they_claim(share):
    rng = np.random.default_rng(5)
    true = np.quantile(np.exp(0.2 * rng.standard_normal(1_000_000)), share)
    intervals = [percentile(np.exp(0.2 * rng.standard_normal(60)), share)[1:] for _ in range(1000)]
    inside = np.mean([low <= true <= (np.inf if high is None else high) for low, high in intervals])
    assert 0.945 <= inside <= 0.99  # exact where ranks allow, never below


def test_few_values_have_no_interval():
    assert percentile(np.array([50.0]), 0.85) == (50.0, None, None)


def test_pace_is_the_fullest_range():
    assert pace(np.array([30, 44, 50, 51, 52, 59, 80.0]), 16.0) == (44.0, 5 / 7)


@pytest.fixture
def week(tmp_path):
    with TrafficLog(tmp_path / "s.sqlite") as log:
        log.add(_clip(0), _rows(range(40, 60)))
        log.add(_clip(1, "2026-03-01T07:00:00Z"), _rows(range(60, 70), hour=7, lane=2))
    return tmp_path / "s.sqlite"


def test_groups_add_up(week):
    for by in ("hour", "day", "weekday", "lane", "direction"):
        found = summarise(week, by, None, None, 50, "UTC")
        total, *groups = found["groups"]
        assert total["vehicles"] == 30 == sum(group["vehicles"] for group in groups)
        assert total["share_above_limit"] == pytest.approx(19 / 30, abs=1e-3)
    assert [g["group"] for g in summarise(week, "hour", None, None, None, "Europe/Vienna")["groups"]][1:] == [
        "07:00",
        "08:00",
    ]
    assert [g["group"] for g in summarise(week, "direction", None, None, None, "UTC")["groups"]][1:] == [
        "90 deg",
        "270 deg",
    ]


def test_since_gaps_and_forms(week):
    found = summarise(week, None, "2026-03-01T08:00+01:00", None, None, "UTC")
    assert found["groups"][0]["vehicles"] == 10
    whole = summarise(week, None, None, None, None, "UTC")
    assert whole["coverage"]["gaps"] == [{"from_utc": "2026-03-01T06:01:00Z", "to_utc": "2026-03-01T07:00:00Z"}]
    assert json.loads(as_text(whole, "json")) == whole
    assert next(csv.DictReader(as_text(whole, "csv").splitlines()))["vehicles"] == "30"
    assert "1 gaps" in as_text(whole, "table")


def test_coverage_is_cut_to_what_was_asked_for(week):
    cut = summarise(week, None, "2026-03-01T06:00:30", "2026-03-01T06:30", None, "UTC")
    assert cut["groups"][0]["vehicles"] == 0
    assert (cut["coverage"]["recordings"], cut["coverage"]["hours"]) == (1, round(30 / 3600, 4))
    assert cut["coverage"]["gaps"] == [{"from_utc": "2026-03-01T06:01:00Z", "to_utc": "2026-03-01T06:30:00Z"}]
    none = summarise(week, None, "2026-03-02", "2026-03-03", None, "UTC")["coverage"]
    assert none["recordings"] == none["hours"] == 0
    assert none["gaps"] == [{"from_utc": "2026-03-02T00:00:00Z", "to_utc": "2026-03-03T00:00:00Z"}]
    with pytest.raises(UsageError, match="not before"):
        summarise(week, None, "2026-03-03", "2026-03-02", None, "UTC")


def test_recordings_without_a_time_of_day_are_named(week):
    untimed = [row | {"time_utc": None} for row in _rows([30])]
    with TrafficLog(week) as log:
        log.add(_clip(2, None), untimed)
    assert summarise(week, None, None, None, None, "UTC")["groups"][0]["vehicles"] == 31
    found = summarise(week, "hour", None, None, None, "UTC")
    assert found["groups"][0]["vehicles"] == 30
    assert found["coverage"]["without_time"] == 1
    assert "1 without a time of day" in as_text(found, "table")


def test_an_older_log_is_migrated_and_read(tmp_path):
    path = tmp_path / "old.sqlite"
    base = sqlite3.connect(path)
    base.executescript(MIGRATIONS[0])
    base.execute(f"PRAGMA application_id = {APPLICATION}")
    base.execute("PRAGMA user_version = 1")
    base.execute("INSERT INTO clips VALUES (1, 'sha0', 'a', 'clip0.mp4', NULL, 60.0, 1500, '0.1.0')")
    base.commit()
    base.close()
    assert [clip["name"] for clip in read(path)[0]] == ["clip0.mp4"]
    with TrafficLog(path) as log:
        assert not log.add(_clip(), [])
        assert log.add(_clip(1), _rows([50]))
    base = sqlite3.connect(path)
    assert base.execute("PRAGMA user_version").fetchone() == (VERSION,)
    assert [clip["name"] for clip in read(path)[0]] == ["clip0.mp4", "clip1.mp4"]


def test_a_recording_is_hashed_once_until_it_changes(tmp_path):
    clip = tmp_path / "a.mp4"
    clip.write_bytes(b"one")
    with TrafficLog(tmp_path / "s.sqlite") as log:
        first = log.digest(clip)
        base = sqlite3.connect(tmp_path / "s.sqlite")
        assert base.execute("SELECT sha256 FROM files").fetchall() == [(first,)]
        base.execute("UPDATE files SET sha256 = 'kept'")
        base.commit()
        assert log.digest(clip) == "kept"
        clip.write_bytes(b"two")
        assert log.digest(clip) == hashlib.sha256(b"two").hexdigest()


KILLED_IN_A_TRANSACTION = """
import os, sqlite3, sys
base = sqlite3.connect(sys.argv[1], isolation_level=None)
base.execute("PRAGMA cache_size = 1")
base.execute("BEGIN IMMEDIATE")
base.execute("UPDATE vehicles SET speed_kmh = 0")
base.executemany("INSERT INTO files VALUES (?, 1, 1, 1, 1, 'x')", [(str(k) * 200,) for k in range(2000)])
os.kill(os.getpid(), 9)
"""


def test_a_writer_killed_in_a_transaction_leaves_the_log_whole(week):
    before = read(week)
    subprocess.run([sys.executable, "-c", KILLED_IN_A_TRANSACTION, str(week)], timeout=60)
    assert week.with_name("s.sqlite-journal").stat().st_size > 0  # it was in the middle of it
    assert read(week) == before


def _visfuse(*args):
    return subprocess.run(
        [sys.executable, "-m", "visfuse_cli", *map(str, args)], capture_output=True, text=True, timeout=600
    )


def test_cron_takes_each_clip_once_and_is_silent(tmp_path):
    arriving = tmp_path / "in"
    arriving.mkdir()
    shutil.copy(SAMPLE / "clip.mp4", arriving / "a_20260301-101500.mp4")
    os.utime(arriving / "a_20260301-101500.mp4", (1, 1))
    shutil.copy(SAMPLE / "clip.mp4", arriving / "b_20260301-111500.mp4")  # written this second
    H, log = tmp_path / "H.json", tmp_path / "site.sqlite"
    _visfuse("calibrate-homography", "--points", SAMPLE / "points.csv", "--out", H)
    common = ("speed", arriving, "--homography", H, "--log", log, "--new-only", "--no-video", "--end", 6, "--out")
    clock = ("--set", "clock.pattern=?_%Y%m%d-%H%M%S".replace("?", "a"), "-q")
    for _ in range(2):
        done = _visfuse(*common, tmp_path / "out", *clock)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    clips, vehicles = read(log)
    assert [clip["began_utc"] for clip in clips] == ["2026-03-01T10:15:00.000Z"]
    with open(tmp_path / "out" / "a_20260301-101500" / "speeds.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["speed_kmh"] for row in vehicles] == [float(row["speed_kmh"]) for row in table]
    assert len(vehicles) >= 2
    (arriving / "c.mp4").write_bytes(b"no video")
    os.utime(arriving / "c.mp4", (1, 1))
    done = _visfuse(*common, tmp_path / "out", "-q")
    assert done.returncode == 3
    assert "c.mp4" in done.stderr
    assert "the other clips are in the log" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--new-only",), 2, "--new-only needs --log"),
        (("--new-only", "--log", "s.sqlite"), 2, "is one recording; give the folder"),
        (("--log", "/nowhere/s.sqlite"), 4, "the log cannot be written"),
        (("--set", "clock.zone=Wien", "--log", "s.sqlite"), 2, "'Wien' is no time zone"),
    ],
)
def test_a_wrong_log_command_is_one_line(tmp_path, options, code, message):
    (tmp_path / "H.json").write_text("{}")
    _visfuse("calibrate-homography", "--points", SAMPLE / "points.csv", "--out", tmp_path / "H.json", "--overwrite")
    options = [tmp_path / option if option == "s.sqlite" else option for option in options]
    done = _visfuse(
        "speed", SAMPLE / "clip.mp4", "--homography", tmp_path / "H.json", "--out", tmp_path / "o", *options
    )
    assert done.returncode == code
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
