"""Batches: what a manifest may say, what a worker leaves behind, and whole batches on real processes."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib import resources
from importlib.util import find_spec
from pathlib import Path

import pytest

from visfuse_cli.apps.batch import work
from visfuse_cli.apps.batch.cluster import connected
from visfuse_cli.apps.batch.manifest import read_manifest
from visfuse_cli.errors import InputError, UsageError
from visfuse_cli.threads import thread_cap

SAMPLE = Path(str(resources.files("visfuse_cli.apps.sample")))
POINTS = "u,v,X,Y\n100,300,0,0\n400,310,6,0\n120,150,0,12\n300,155,6,12\n210,200,3,6\n"
needs_dask = pytest.mark.skipif(find_spec("distributed") is None, reason="Dask is not installed (extra `batch`)")


@pytest.fixture
def site(tmp_path):
    """A folder with three surveys, a homography, clips (never opened), and a manifest to be written."""
    for name in ("a", "b", "c2", "c10"):
        (tmp_path / f"{name}.csv").write_text(POINTS)
    (tmp_path / "clips").mkdir()
    for name in ("day-2", "day-10", "night 1"):
        (tmp_path / "clips" / f"{name}.mp4").write_bytes(b"")
        (tmp_path / "clips" / f"{name}.txt").write_bytes(b"")
    (tmp_path / "H.json").write_text("{}")
    (tmp_path / "night.yaml").write_text("filter: {kind: ekf}\n")
    return tmp_path


def manifest(site, text):
    (site / "m.yaml").write_text(text)
    return site / "m.yaml"


def items(site, text):
    return read_manifest(manifest(site, text), site / "out")


SPEED = "items: [{command: speed, input: 'clips/*.mp4', homography: H.json%s}]"


def test_globs_open_in_natural_order_with_overrides(site):
    found = items(
        site,
        """
        retries: 2
        defaults: {seed: 7, homography: H.json}
        items:
          - command: speed
            input: clips/*.mp4
            detections: "{parent}/{stem}.txt"
            set: {filter.kind: imm}
            overrides:
              clips/night*: {config: night.yaml, end: 5, set: {filter.sigma_a: 1e-1}}
          - {command: calibrate-homography, points: 'c*.csv', size: 640x480, name: cal, set: {noise.sigma_px: 1e-1}}
        """,
    )
    assert [item.name for item in found] == [
        "speed-clips-day-2",
        "speed-clips-day-10",
        "speed-clips-night_1",
        "cal-c2",
        "cal-c10",
    ]
    day, _, night, survey, _ = (item.request for item in found)
    assert (day.seed, day.end, night.end) == (7, None, 5)
    assert (day.config.filter.kind, night.config.filter.kind, night.config.filter.sigma_a) == ("imm", "imm", 0.1)
    assert night.options["detections"] == site / "clips" / "night 1.txt"
    assert survey.options["points"] == survey.input == site / "c2.csv"
    assert (survey.options["size"], survey.config.noise.sigma_px) == ((640, 480), 0.1)
    assert survey.out == site / "out" / "cal-c2" / "H.json"
    assert {item.retries for item in found} == {2}


BAD = {
    "not there": (None, "cannot read the manifest"),
    "a list": ("- 1", "a mapping with the key `items`"),
    "no items": ("items: []", "'items' should be"),
    "unknown key": ("itemz: []", "unknown key 'itemz'; did you mean 'items'"),
    "items of words": ("items: [speed]", "items.0"),
    "alias bomb": ("a: &a [x]\nitems: [*a, *a]", "aliases"),
    "python object": ("items: !!python/object/apply:os.system ['true']", "not valid YAML"),
    "command": ("items: [{command: sped, input: a}]", "did you mean 'speed'"),
    "command on": ("items: [{command: on, input: a}]", "command: 'on'"),
    "no command": ("items: [{input: a}]", "command: None"),
    "no input": ("items: [{command: speed, homography: H.json}]", "speed needs input"),
    "number as input": ("items: [{command: speed, input: 7, homography: H.json}]", "a path or a glob"),
    "NUL": ('items: [{command: speed, input: "a\\0b", homography: H.json}]', "a path or a glob"),
    "two tables": ("items: [{command: calibrate-homography, points: a.csv, lines: b.csv}]", "exactly one of"),
    "missing input": ("items: [{command: speed, input: no.mp4, homography: H.json}]", "there is no such file"),
    "empty glob": ("items: [{command: speed, input: 'x*.mp4', homography: H.json}]", "fits no file"),
    "missing homography": ("items: [{command: speed, input: clips, homography: G.json}]", "homography: "),
    "without homography": ("items: [{command: speed, input: clips}]", "'homography' Field required"),
    "option of another": (SPEED % ", estimate_offsets: true", "unknown key 'estimate_offsets'"),
    "misspelt": (SPEED % ", detectoins: x", "did you mean 'detections'"),
    "video maybe": (SPEED % ", video: maybe", "'video' should be a valid boolean"),
    "nan": (SPEED % ", end: .nan", "'end' should be"),
    "window": (SPEED % ", start: 3, end: 1e-3", "start 3 is not before end 0.001"),
    "name": (SPEED % ", name: ../up", "'name' should"),
    "retries": (SPEED % ", retries: many", "retries: 'many'"),
    "set key": (SPEED % ", set: {filter.kinds: ekf}", "did you mean 'kind'"),
    "set value": (SPEED % ", set: {filter.sigma_a: .inf}", "filter.sigma_a"),
    "set list": (SPEED % ", set: [filter.kind=ekf]", "'set' should be"),
    "config": (SPEED % ", config: trafic", "did you mean 'traffic'"),
    "config file": (SPEED % ", config: no.yaml", "no.yaml: cannot read"),
    "override of nothing": (SPEED % ", overrides: {'clips/x*': {end: 1}}", "fits no input"),
    "override list": (SPEED % ", overrides: [1]", "a mapping of patterns"),
    "override command": (SPEED % ", overrides: {'clips/*': {command: speed}}", "cannot differ"),
    "defaults": ("defaults: {sead: 1}\nitems: [{command: speed, input: a}]", "did you mean 'seed'"),
    "size": ("items: [{command: calibrate-homography, points: a.csv, size: 0x9}]", "'size'"),
    "same name twice": (
        "items: [{command: calibrate-homography, points: a.csv, name: x},"
        " {command: calibrate-homography, points: b.csv, name: x}]",
        "another item has the name 'x'",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_manifest_is_one_line(kind, site):
    text, message = BAD[kind]
    with pytest.raises(InputError) as refused:
        read_manifest(site / "no.yaml", site / "out") if text is None else items(site, text)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_mistakes_are_told_with_their_line(site):
    with pytest.raises(InputError, match=r"m\.yaml, line 4: .*'ende'"):
        items(site, "items:\n  - command: speed\n    input: clips\n    ende: 3\n    homography: H.json\n")
    with pytest.raises(InputError, match=r"m\.yaml, line 2: .*'ende'"):
        items(site, "items:\n - {command: speed, input: clips, homography: H.json, overrides: {clips: {ende: 3}}}\n")


def test_a_worker_leaves_log_and_record_and_keeps_what_is_finished(site):
    (item,) = items(site, "items: [{command: calibrate-homography, points: a.csv}]")
    assert work.kept(item) is None
    outcome = work.perform(item, 1)
    assert (outcome.status, outcome.code, outcome.warnings) == ("done", 0, 1)
    folder = site / "out" / item.name
    assert {path.name for path in folder.iterdir()} == {"H.json", "batch.json", "batch.log"}
    assert "leave little to check" in (folder / "batch.log").read_text()
    assert work.kept(item).status == "kept"
    assert work.kept(items(site, "items: [{command: calibrate-homography, points: a.csv, size: 9x9}]")[0]) is None
    (site / "a.csv").write_text(POINTS + "1,2,3,4\n")
    assert work.kept(item) is None
    assert thread_cap() is None  # the cap held for the run alone


def test_what_fails_for_good_is_not_tried_again_and_a_defect_is(site, monkeypatch):
    (site / "b.csv").write_text("u,v\n")
    bad, good = items(site, "retries: 1\nitems: [{command: calibrate-homography, points: '[ab].csv'}]")[::-1]
    outcome = work.perform(bad, 1)
    assert (outcome.status, outcome.code) == ("failed", 3)
    assert "b.csv" in outcome.message
    assert "failed: " in (site / "out" / bad.name / "batch.log").read_text()
    monkeypatch.setattr(work, "_run", lambda item: 1 / 0)
    with pytest.raises(work.ItemFailed) as raised:
        work.perform(good, 1)
    assert raised.value.outcome.code == 1
    assert "Traceback" in (site / "out" / good.name / "batch.log").read_text()
    assert work.kept(good) is None


@pytest.mark.parametrize(("value", "cap"), [("", None), ("3", 3)])
def test_the_cap_of_threads_is_read(value, cap, monkeypatch):
    monkeypatch.setenv("VISFUSE_THREADS", value)
    assert thread_cap() == cap


@pytest.mark.parametrize("value", ["0", "-1", "many", "1e3", "99999"])
def test_a_cap_that_is_none_is_refused(value, monkeypatch):
    monkeypatch.setenv("VISFUSE_THREADS", value)
    with pytest.raises(UsageError, match="VISFUSE_THREADS"):
        thread_cap()


def test_without_dask_a_batch_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"pip install 'visfuse-cli\[batch\]'"), connected(1, None):
        pass


def visfuse(*args, **more):
    command = [sys.executable, "-m", "visfuse_cli", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, **more)


def statuses(out):
    with open(out / "results.csv", newline="") as file:
        return {row["name"]: row["status"] for row in csv.DictReader(file)}


@needs_dask
def test_failures_stop_a_batch_or_not_and_it_is_resumed(site):
    (site / "b.csv").write_text("u,v\n")
    path = manifest(site, "items: [{command: calibrate-homography, points: '*.csv', name: x}]")
    done = visfuse("batch", path, "--out", site / "out", "--workers", 1)
    assert done.returncode == 3
    assert len(done.stderr.splitlines()) == 1
    assert "x-b: " in done.stderr
    assert statuses(site / "out") == {"x-a": "done", "x-b": "failed", "x-c2": "left", "x-c10": "left"}
    assert visfuse("batch", path, "--out", site / "out").returncode == 4
    made = (site / "out" / "x-a" / "H.json").stat().st_mtime_ns
    (site / "b.csv").write_text(POINTS)
    done = visfuse("batch", path, "--out", site / "out", "--resume", "--keep-going", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    found = json.loads(done.stdout)
    assert (found["kept"], found["done"], found["failed"]) == (1, 3, 0)
    assert (site / "out" / "x-a" / "H.json").stat().st_mtime_ns == made


@needs_dask
def test_a_worker_killed_in_the_middle_loses_nothing(site):
    shutil.copy(SAMPLE / "clip.mp4", site / "clip.mp4")
    visfuse(*"calibrate-homography --overwrite --points".split(), SAMPLE / "points.csv", "--out", site / "H.json")
    item = "{command: speed, input: clip.mp4, homography: H.json, end: 4, video: false, report: false, name: x}"
    command = [sys.executable, "-m", "visfuse_cli", "batch", manifest(site, f"items: [{item}]"), "--out", site / "out"]
    running = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    spool, log = site / "out" / "x" / ".tracks.partial.jsonl", site / "out" / "x" / "batch.log"
    deadline = time.monotonic() + 120
    while not spool.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(int(log.read_text().split("process ")[1].split(":")[0]), signal.SIGKILL)
    output, errors = running.communicate(timeout=240)
    assert (running.returncode, errors) == (0, "")
    assert "1 done" in output
    assert log.read_text().count("process ") == 2
    whole = visfuse(
        *("speed", site / "clip.mp4", "--homography", site / "H.json", "--end", 4, "--no-video", "--no-report", "-q"),
        *("--out", site / "alone"),
    )
    assert whole.returncode == 0
    for name in ("tracks.json", "speeds.csv", "rejected.csv"):
        assert (site / "alone" / name).read_bytes() == (site / "out" / "x" / name).read_bytes()
