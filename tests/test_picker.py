"""The picker: its server refuses what is foreign, its desk fits and saves, and its page works in a browser."""

import http.client
import json
import re
import signal
import subprocess
import sys
from importlib import resources
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from tests.chromium import page
from visfuse_cli.apps.picker.desk import Desk
from visfuse_cli.apps.picker.server import Server
from visfuse_cli.commands.calibrate_homography import CalibrateConfig
from visfuse_cli.errors import InputError, OutputError, UsageError
from visfuse_cli.files import homography
from visfuse_cli.files.calibration_input import read_points
from visfuse_cli.files.stills import Stills
from visfuse_cli.maths.layout import dashes, from_distances, rectangle
from visfuse_cli.records import RunRequest
from visfuse_cli.vision.corners import snap_line, snap_point

SAMPLE = Path(str(resources.files("visfuse_cli.apps.sample")))


def request(out: Path, overwrite: bool = False) -> RunRequest:
    clip = SAMPLE / "clip.mp4"
    options = {"points": None, "lines": None, "gaze": None, "image": None, "size": None, "camera": None, "pick": clip}
    return RunRequest("calibrate-homography", clip, out, CalibrateConfig(), options, overwrite)


def sheet(marks: np.ndarray, world: np.ndarray | None, **more: object) -> dict:
    n = len(marks)
    known = [None] * n if world is None else world.tolist()
    return {"noun": "point", "marks": marks.tolist(), "world": known, "lines": [0] * n} | more


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(request(tmp_path / "H.json"))


def ask(server: Server, method: str, path: str, body: object = None, **headers: str) -> tuple[int, bytes]:
    """One raw request: what is asked is sent as it is, without a client's tidying."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    named = {"Host": f"127.0.0.1:{server.port}"} | {name.replace("_", "-"): value for name, value in headers.items()}
    connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    data = b"" if body is None else json.dumps(body).encode()
    if data:
        named = {"Content-Type": "application/json", "Content-Length": str(len(data))} | named
    for name, value in named.items():
        connection.putheader(name, value)
    connection.endheaders(data)
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_nothing_is_answered_without_the_token_or_to_a_foreign_host(desk: Desk):
    with Server(desk) as server:
        token = urlsplit(server.address).path
        assert len(token) > 30
        assert ask(server, "GET", token)[0] == 200
        assert ask(server, "GET", token + "about")[0] == 200
        for path in ("/", "/about", "/style.css", token[:-2] + "/", token.swapcase() + "about", token[:-1]):
            status, body = ask(server, "GET", path)
            assert (status, body) == (403, b"Forbidden"), path
        for host in ("evil.example", f"evil.example:{server.port}", "127.0.0.1", f"127.0.0.2:{server.port}", ""):
            assert ask(server, "GET", token + "about", Host=host)[0] == 403, host
        assert ask(server, "GET", token + "about", Origin="http://evil.example")[0] == 403
        assert ask(server, "POST", "/save", sheet(np.zeros((4, 2)), None))[0] == 403
        foreign = {"Origin": "http://evil.example"}
        assert ask(server, "POST", token + "save", sheet(np.zeros((4, 2)), None), **foreign)[0] == 403
    assert not desk.done.is_set()


def test_it_listens_on_this_machine_alone(desk: Desk):
    with Server(desk) as server:
        assert server.address.startswith("http://127.0.0.1:")
        assert server._http.server_address[0] == "127.0.0.1"


def test_no_path_climbs_out(desk: Desk, tmp_path: Path):
    (tmp_path / "secret").write_text("hidden")
    with Server(desk) as server:
        token = urlsplit(server.address).path
        for climb in (
            "../secret",
            "../../../../etc/passwd",
            "%2e%2e/secret",
            "..%2fsecret",
            "page/../../desk.py",
            "/etc/passwd",
            "style.css/../../server.py",
            "main.js%00",
            f"{tmp_path}/secret",
        ):
            status, body = ask(server, "GET", token + climb)
            assert status in (403, 404), climb
            assert b"hidden" not in body
            assert ask(server, "POST", token + climb, {})[0] in (403, 404)
        marks, world = read_points(SAMPLE / "points.csv")
        for name in ("out", "path", "name", "saved"):
            status, body = ask(server, "POST", token + "save", sheet(marks, world, **{name: "../../climbed.json"}))
            assert status == 422, name
            assert b"unknown key" in body
        assert ask(server, "GET", token + "frame?t=../../secret")[0] == 400
    assert sorted(path.name for path in tmp_path.iterdir()) == ["secret"]


def test_what_is_no_request_of_the_page_is_refused(desk: Desk):
    with Server(desk) as server:
        token = urlsplit(server.address).path
        assert ask(server, "POST", token + "fit", {}, Content_Type="text/plain")[0] == 415
        assert ask(server, "POST", token + "fit", [1])[0] == 400
        assert ask(server, "POST", token + "fit", {"a": 1}, Content_Length="99999999")[0] == 413
        assert ask(server, "POST", token + "fit", {"noun": "point"})[0] == 422
        assert ask(server, "GET", token + "frame")[0] == 400
        assert ask(server, "GET", token + "frame?t=nan")[0] == 422
        status, body = ask(server, "GET", token + "frame?t=1.0")
        assert status == 200
        assert body.startswith(b"\x89PNG")


def test_a_taken_port_is_told(desk: Desk):
    with Server(desk) as server, pytest.raises(OutputError, match="cannot be served on"):
        Server(desk, server.port)


def test_what_is_saved_is_what_the_command_makes_of_the_saved_points(desk: Desk, tmp_path: Path):
    marks, world = read_points(SAMPLE / "points.csv")
    live = desk.fit(sheet(marks + 0.12345, world))
    assert live["fits"]
    assert live["grid"]
    assert live["expect_kmh"] > 0
    assert len(live["residuals"]) == len(marks)
    desk.save(sheet(marks + 0.12345, world, t=2.0))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["H.json", "H.png", "H.points.csv"]
    saved = homography.read(tmp_path / "H.json")
    command = [
        "calibrate-homography",
        "--points",
        "H.points.csv",
        "--image",
        str(SAMPLE / "clip.mp4"),
        "--out",
        "2.json",
    ]
    done = subprocess.run([sys.executable, "-m", "visfuse_cli", *command], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    again = homography.read(tmp_path / "2.json")
    np.testing.assert_array_equal(saved.ground_from_image, again.ground_from_image)
    np.testing.assert_array_equal(saved.cov, again.cov)
    with pytest.raises(OutputError, match="exists"):
        Desk(request(tmp_path / "H.json"))
    before = Desk(request(tmp_path / "H.json", overwrite=True)).about()["before"]
    np.testing.assert_allclose(before["marks"], marks + 0.123)


@pytest.mark.parametrize(
    ("marks", "why"),
    [
        (np.zeros((0, 2)), "needs four points"),
        (np.array([[0.0, 0], [1, 1], [2, 2], [3, 3]]), "on one line"),
        (np.array([[0.0, 0], [0, 0], [200, 2], [3, 300]]), "same point"),
    ],
)
def test_where_there_is_no_fit_there_is_a_reason(desk: Desk, marks: np.ndarray, why: str):
    world = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])[: len(marks)]
    answer = desk.fit(sheet(marks, world))
    assert not answer["fits"]
    assert why in answer["reason"]
    assert ".csv" not in answer["reason"]
    with pytest.raises(InputError):
        desk.save(sheet(marks, world))


def test_marks_without_metres_and_malformed_sheets_are_named(desk: Desk):
    marks = np.array([[0.0, 0], [100, 0], [100, 90], [0, 100]])
    assert "point 1 has no metres yet" in desk.fit(sheet(marks, None))["reason"]
    with pytest.raises(UsageError, match="as many marks"):
        desk.fit(sheet(marks, None) | {"lines": [0]})
    with pytest.raises(UsageError, match="needs 2 numbers"):
        desk.fit(sheet(marks, np.zeros((4, 3))))


def test_patterns_give_the_metres_that_were_measured(desk: Desk):
    marks, world = read_points(SAMPLE / "points.csv")
    lines = np.array([0, 0, 0, 1, 1, 1])
    np.testing.assert_allclose(dashes(lines, 3.5, 12)[[1, 5]], [[0, 12], [3.5, 24]])
    np.testing.assert_allclose(dashes(lines, 3.5, 12, 4)[[1, 2]], [[0, 4], [0, 12]])
    np.testing.assert_allclose(rectangle(2, 5), [[0, 0], [2, 0], [2, 5], [0, 5]])
    pairs = [(a, b) for a in range(len(marks)) for b in range(a)]
    lengths = [float(np.hypot(*(world[a] - world[b]))) for a, b in pairs]
    pattern = {"kind": "distances", "pairs": [[a + 1, b + 1, d] for (a, b), d in zip(pairs, lengths, strict=True)]}
    answer = desk.fit(sheet(marks, None, pattern=pattern))
    assert answer["fits"], answer
    found = np.array(answer["world"])
    np.testing.assert_allclose(
        np.linalg.norm(found[:, None] - found, axis=-1), np.linalg.norm(world[:, None] - world, axis=-1), atol=0.02
    )
    assert answer["rms_px"] < 2  # mirrored or folded, no homography leads there from the picture


def test_distances_fold_as_the_picture_shows_or_are_refused():
    """Five distances between four points leave two foldings; seen from above only one keeps every turn."""
    world = np.array([[0.0, 0.0], [0.0, 8.0], [3.0, 1.0], [4.0, 7.0]])
    pairs = np.array([[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]])
    lengths = np.linalg.norm(world[pairs[:, 0]] - world[pairs[:, 1]], axis=1)
    image = world * [10, -10] + 100
    found, off = from_distances(pairs, lengths, image)
    np.testing.assert_allclose(found, world, atol=1e-5)
    assert np.abs(off).max() < 1e-5
    with pytest.raises(InputError, match="5 distances or more"):
        from_distances(pairs[:4], lengths[:4], image)
    twice = np.array([[0, 1], [1, 0], [0, 2], [2, 0], [1, 2]])
    with pytest.raises(InputError, match="free to move"):
        from_distances(twice, np.linalg.norm(world[twice[:, 0]] - world[twice[:, 1]], axis=1), image)


def start(out: Path) -> tuple[subprocess.Popen, str]:
    command = [sys.executable, "-m", "visfuse_cli", "calibrate-homography", "--pick", str(SAMPLE / "clip.mp4")]
    process = subprocess.Popen([*command, "--out", str(out)], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stderr is not None
    address = re.search(r"http://127\.0\.0\.1:\d+/\S+/", process.stderr.readline())
    assert address
    return process, address[0]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_it_with_nothing_saved(tmp_path: Path, number: signal.Signals, code: int):
    process, _ = start(tmp_path / "H.json")
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert process.returncode == code
    assert out == "nothing was saved\n"
    assert err == ""
    assert list(tmp_path.iterdir()) == []


def test_in_a_browser_points_are_clicked_typed_judged_and_saved(tmp_path: Path):
    marks, world = read_points(SAMPLE / "points.csv")
    with page(1400, 850) as window:
        process, address = start(tmp_path / "H.json")
        window.goto(address)
        window.wait_for_selector("#verdict:has-text('four points or more')")
        box, (width, height) = window.locator("#view").bounding_box(), (960, 540)
        zoom = min(box["width"] / width, box["height"] / height)
        corner = [(width - box["width"] / zoom) / 2 - 0.5, (height - box["height"] / zoom) / 2 - 0.5]
        window.fill("#radius", "4")
        for k, (u, v) in enumerate(marks, 1):
            window.mouse.click(box["x"] + (u - corner[0]) * zoom, box["y"] + (v - corner[1]) * zoom)
            window.wait_for_selector(f"#table tbody tr:nth-child({k}).chosen td:nth-child(4) input:focus")
            window.keyboard.type(f"{world[k - 1][0]:g}")
            window.keyboard.press("Tab")
            window.keyboard.type(f"{world[k - 1][1]:g}")
        window.wait_for_selector("#verdict.good")
        assert window.locator("#table tbody tr").count() == len(marks)
        window.locator("#view").focus()
        window.keyboard.press("ArrowLeft")  # moves the chosen mark, so that there is something to undo
        window.click("#undo")
        assert window.locator("#table tbody tr").count() == len(marks)
        window.wait_for_selector("#save:enabled")
        window.click("#save")
        window.wait_for_selector("dialog[open]:has-text('Saved')")
        out, _ = process.communicate(timeout=20)
    assert process.returncode == 0
    assert "picked" in out
    found, metres = read_points(tmp_path / "H.points.csv")
    np.testing.assert_allclose(metres, world, atol=1e-4)
    assert np.abs(found - marks).max() < 5  # snapped, or as clicked
    assert homography.read(tmp_path / "H.json").image_size == (width, height)


def stripe(ends: np.ndarray, width: float) -> np.ndarray:
    """A bright stripe on dark asphalt, its middle line through ends (2, 2) px, every pixel antialiased."""
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    side = np.array([-along[1], along[0]]) * width / 2
    corners = np.stack([ends[0] + side, ends[0] - side, ends[1] - side, ends[1] + side])
    large = np.full((240 * 8, 320 * 8), 70, np.uint8)
    cv2.fillConvexPoly(large, np.round((corners + 0.5) * 8 - 0.5).astype(int), 190)
    small = cv2.resize(large, (320, 240), interpolation=cv2.INTER_AREA).astype(float)
    return np.clip(small + np.random.default_rng(0).normal(0, 2, small.shape), 0, 255).astype(np.uint8)


def test_a_click_snaps_to_the_middle_of_a_dashs_end_or_to_its_corner():
    ends, width = np.array([[150.3, 190.6], [170.2, 90.1]]), 7.0
    image = stripe(ends, width)
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    side = np.array([-along[1], along[0]]) * width / 2
    for off in ([0.8, -0.7], [-0.5, 1.0], [0.0, 0.0]):
        found = snap_point(image, ends[0] + off, 5.0)
        assert found is not None
        assert np.linalg.norm(found - ends[0]) < 0.4, off
    corner = snap_point(image, ends[0] + side + [0.3, 0.4], 5.0)
    assert corner is not None
    assert np.linalg.norm(corner - ends[0] - side) < 0.6
    assert snap_point(np.full((240, 320), 80, np.uint8), np.array([40.0, 60.0]), 5.0) is None


def test_a_drawn_line_snaps_to_the_edge_under_it():
    ends = np.array([[150.3, 190.6], [170.2, 90.1]])
    image = stripe(ends, 30.0)
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    side = np.array([-along[1], along[0]])
    edge = ends[::-1] + 15 * side - np.outer([10, -10], along)
    found = snap_line(image, (edge + 1.5 * side).ravel(), 6.0)
    assert found is not None
    assert np.abs((found.reshape(2, 2) - edge) @ side).max() < 0.3
    assert snap_line(image, np.array([20.0, 20, 60, 25]), 5.0) is None


def test_a_defect_costs_nothing_that_was_picked(desk: Desk, monkeypatch: pytest.MonkeyPatch, capsys):
    def broken(asked: dict) -> dict:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(desk, "snap", broken)
    with Server(desk) as server:
        token = urlsplit(server.address).path
        status, body = ask(server, "POST", token + "snap", {})
        assert (status, json.loads(body)) == (500, {"reason": "internal error: oh"})
        assert ask(server, "GET", token + "about")[0] == 200
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_a_frame_is_found_by_its_time_in_clips_folders_and_pictures(tmp_path: Path):
    clip = Stills(SAMPLE / "clip.mp4")
    assert (clip.size, clip.duration) == ((960, 540), pytest.approx(9.96))
    assert [clip.at(t)[0] for t in (0, 0.03, 1.0, 5.02, 1e6)] == pytest.approx([0, 0, 1.0, 5.0, 9.96])
    times = [0.0, 0.5, 0.6, 2.0]
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((48, 64, 3), 10 * k, np.uint8))
    (tmp_path / "timestamps.csv").write_text("frame,t\n" + "".join(f"{k},{t}\n" for k, t in enumerate(times)))
    folder = Stills(tmp_path)
    assert folder.duration == 2.0
    for t, k in ((0, 0), (0.49, 0), (0.5, 1), (1.9, 2), (2.0, 3), (1e6, 3)):
        when, image = folder.at(t)
        assert (when, int(image[0, 0, 0])) == (times[k], 10 * k), t
    assert Stills(tmp_path / "2.png").at(7.0)[0] == 0.0
