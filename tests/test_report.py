"""The report: everything a run folder holds, on one page that needs no network."""

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from tests.chromium import page
from visfuse_cli import report
from visfuse_cli.errors import InputError
from visfuse_cli.files.spool import TrackSpool
from visfuse_cli.files.video_writer import VideoWriter, begin_of

SAMPLE = Path(str(resources.files("visfuse_cli.apps.sample")))


def _visfuse(*args):
    command = [sys.executable, "-m", "visfuse_cli", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    H = folder / "H.json"
    _visfuse("calibrate-homography", "--points", SAMPLE / "points.csv", "--image", SAMPLE / "clip.mp4", "--out", H)
    done = _visfuse("speed", SAMPLE / "clip.mp4", "--homography", H, "--out", folder / "run", "--end", 5)
    assert done.returncode == 0, done.stderr
    return folder / "run"


class _Page(HTMLParser):
    def __init__(self):
        super().__init__()
        self.sources, self.rows, self.open = [], 0, []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.sources += [values[name] for name in ("src", "href") if name in values]
        self.rows += tag == "tr" and "data-seek" in values
        if tag in ("section", "table", "video", "script", "style"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag in ("section", "table", "video", "script", "style"):
            assert self.open.pop() == tag


def _page(path):
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    assert page.open == []
    return page


def test_a_run_ends_with_a_page_that_needs_nothing_else(run):
    page = _page(run / "report.html")
    assert page.rows >= 2
    assert all(source.startswith("data:") for source in page.sources), "something is loaded from elsewhere"
    text = (run / "report.html").read_text(encoding="utf-8")
    assert text.count("<svg") == 2
    assert "data:video/mp4" in text
    assert "data:image/png" in text  # the calibration's picture
    for word in ("50th percentile", "Rejected", "Normalised innovation squared", "How it was made"):
        assert word in text
    tracks = json.loads(re.search(r'class="tracks">(.*?)</script>', text, re.DOTALL)[1])
    assert {track["id"] for track in tracks["tracks"]} == {
        t["id"] for t in json.loads((run / "tracks.json").read_text())["tracks"]
    }


def test_the_same_run_makes_the_same_page(run, tmp_path):
    first = report.write([run], tmp_path / "a.html").read_bytes()
    assert first == report.write([run], tmp_path / "b.html").read_bytes()


def test_several_runs_share_a_page(run, tmp_path):
    done = _visfuse("report", run, run, "--out", tmp_path / "both.html")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "both.html").read_text(encoding="utf-8").count("<section") == 2


def _moving_run(folder):
    """Tracks in 3D without tables or video, with several motion models."""
    states = [
        {
            "frame": k,
            "t": k / 10,
            "position": [0.1 * k, 0.0, 5.0 + 0.2 * k],
            "velocity": [1.0, 0.0, 2.0],
            "speed": 2.2,
            "speed_sigma": 0.1,
            "measured": True,
            "models": {"cv": 0.7, "ca": 0.3},
        }
        for k in range(30)
    ]
    summary = {"t_start": 0.0, "t_end": 2.9, "n_frames": 30, "distance": 6.5, "speed": 2.2, "speed_ci95": [2.1, 2.3]}
    with TrackSpool(folder, "track-imm", 0, "left-camera-at-start") as tracks:
        tracks.add({"id": 1, "summary": summary, "states": states})
    document = {
        **{"command": "track-imm", "version": "1", "finished": "now", "seed": 0, "stopped_by": None},
        **{"command_line": [], "inputs": [], "versions": {}, "warnings": ["</script><b>"], "time_audit": {}},
    }
    (folder / "run.json").write_text(json.dumps(document))


def test_a_run_of_a_moving_camera_has_a_page(tmp_path):
    _moving_run(tmp_path)
    text = report.write([tmp_path]).read_text(encoding="utf-8")
    assert "Motion models of track 1" in text
    assert "</script><b>" not in text
    assert _page(tmp_path / "report.html").rows == 1


def test_depth_is_shown_beside_speed_where_the_frame_is_a_cameras_that_stands(tmp_path):
    _moving_run(tmp_path)
    assert "Depth over time" not in report.write([tmp_path]).read_text(encoding="utf-8")
    tracks = tmp_path / "tracks.json"
    tracks.write_text(tracks.read_text(encoding="utf-8").replace("left-camera-at-start", "left-camera"))
    text = report.write([tmp_path]).read_text(encoding="utf-8")
    assert text.count("Depth over time") == 1
    shown = text[text.index("Depth over time") :]
    assert "depth (m)" in shown[: shown.index("</svg>")]
    assert 'class="track-1"' in shown[: shown.index("</svg>")]


def test_what_is_too_large_to_embed_is_linked(run, tmp_path, monkeypatch):
    monkeypatch.setattr(report.page, "EMBEDDED_BYTES", 1000)
    text = report.write([run], tmp_path / "linked.html").read_text(encoding="utf-8")
    assert "data:video/mp4" not in text
    assert f'src="{os.path.relpath(run / "annotated.mp4", tmp_path)}"' in text


def test_in_a_browser_a_click_seeks_and_heads_sort(run):
    with page(1280, 900) as window:
        window.goto((run / "report.html").as_uri())
        row = window.locator("tr[data-seek]").nth(1)
        wanted = float(row.get_attribute("data-seek"))
        row.locator("button").focus()
        window.keyboard.press("Enter")  # no mouse is needed
        window.wait_for_function(f"Math.abs(document.querySelector('video').currentTime - {wanted}) < 0.05")
        assert "chosen" in row.get_attribute("class")
        window.wait_for_function("document.querySelectorAll('.speeds g.chosen').length > 0")
        assert (
            window.evaluate("getComputedStyle(document.querySelector('.speeds g[class^=track-]:not(.chosen)')).opacity")
            < "1"
        )

        speed = window.locator("table.sortable").first.locator("th button", has_text="speed")
        cells = (
            "[...document.querySelector('table.sortable').tBodies[0].rows].map(row => Number(row.cells[4].textContent))"
        )
        for sign in (1, -1):
            speed.click()
            shown = window.evaluate(cells)
            assert shown == sorted(shown, reverse=sign < 0)
            assert len(shown) > 1


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_on_a_phone_nothing_sticks_out(run, scheme):
    with page(390, 844, color_scheme=scheme) as window:
        window.goto((run / "report.html").as_uri())
        assert window.evaluate("document.documentElement.scrollWidth <= innerWidth")
        ink, paper = (
            window.evaluate(f"getComputedStyle(document.body).{name}") for name in ("color", "backgroundColor")
        )
        light, dark = (
            sum(map(int, re.findall(r"\d+", colour)[:3]))
            for colour in ((paper, ink) if scheme == "light" else (ink, paper))
        )
        assert light - dark > 400
        assert window.evaluate("getComputedStyle(document.querySelector('.plot text')).fill") == ink


def test_without_a_video_the_map_has_a_clock_of_its_own(tmp_path):
    _moving_run(tmp_path)
    report.write([tmp_path])
    with page(1000, 800) as window:
        window.goto((tmp_path / "report.html").as_uri())
        window.locator("tr[data-seek] button").first.click()
        assert window.locator("output").inner_text() == "0.0 s"
        window.click("text=Play")
        window.wait_for_function("parseFloat(document.querySelector('output').textContent) > 0.2")
        window.click("text=Pause")


def test_a_video_that_begins_later_is_sought_by_the_footages_time(tmp_path):
    """A run of --start 5: its video begins with its first picture, its tracks keep the footage's clock."""
    _moving_run(tmp_path)
    with VideoWriter(tmp_path / "annotated.mp4", 64, 48, 10) as video:
        for k in range(30):
            video.write(np.full((48, 64, 3), 8 * k, np.uint8), 5 + k / 10)
    assert begin_of(tmp_path / "annotated.mp4") == 5
    document = json.loads((tmp_path / "tracks.json").read_text())
    for state in document["tracks"][0]["states"]:
        state["t"] += 6.5
    (tmp_path / "tracks.json").write_text(json.dumps(document))
    report.write([tmp_path])
    with page(1000, 800) as window:
        window.goto((tmp_path / "report.html").as_uri())
        window.wait_for_function("Math.abs(document.querySelector('video').duration - 3) < 0.2")
        window.locator("tr[data-seek] button").first.click()
        window.wait_for_function("Math.abs(document.querySelector('video').currentTime - 1.5) < 0.05")
        window.wait_for_selector("tr.now")


def test_a_calibration_has_a_page(run, tmp_path):
    H = run.parent / "H.json"
    done = _visfuse("report", H, run, "--out", tmp_path / "both.html")
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "both.html").read_text(encoding="utf-8")
    marks = len(json.loads(H.read_text())["residuals"])
    assert f"{marks} of {marks}" in text
    assert text.count("data:image/png") == 2
    with page(390, 844) as window:
        window.goto((tmp_path / "both.html").as_uri())
        assert window.locator("section").first.locator("tbody tr").count() == marks
        assert window.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert report.write([H]) == H.with_suffix(".html")


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match="not a run folder"):
        report.write([tmp_path])
    (tmp_path / "run.json").write_text("[]")
    with pytest.raises(InputError, match="holds one JSON object"):
        report.write([tmp_path])
    assert not (tmp_path / "report.html").exists()
