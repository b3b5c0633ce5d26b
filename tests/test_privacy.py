"""What privacy blurs: plates, heads, and whatever moves without being a track."""

import json
import subprocess
import sys

import av
import cv2
import numpy as np
import pytest
from masks import CAR, road_camera

from samples.files import write_scene
from samples.road import free_flow
from visfuse_cli.maths.cameras import project
from visfuse_cli.records import Region
from visfuse_cli.tracking.privacy import Strangers, parts
from visfuse_cli.vision.blurring import blur

CAMERA = road_camera()


def stripes(high=240, wide=320):
    picture = np.zeros((high, wide, 3), np.uint8)
    picture[:, ::4], picture[:, 1::4] = 255, 255
    return picture


def test_stripes_inside_an_outline_are_gone_and_nothing_else_changes():
    picture = stripes()
    outline = np.array([[60.0, 60], [160, 60], [160, 120], [60, 120]])
    blur(picture, [outline, np.full((4, 2), np.nan), outline + 9000, np.zeros((0, 2))])
    inside = picture[64:116, 64:156]
    assert np.ptp(inside.astype(int)) < 40
    untouched = np.ones(picture.shape[:2], bool)
    untouched[59:122, 59:162] = False
    np.testing.assert_array_equal(picture[untouched], stripes()[untouched])


@pytest.mark.parametrize("corner", [(-30.0, -30.0), (300.0, 220.0), (-10.0, 100.0)])
def test_outlines_over_the_border_are_cut(corner):
    picture = stripes()
    blur(picture, [np.array([[0.0, 0], [60, 0], [60, 60], [0, 60]]) + corner])
    assert (picture != stripes()).any()


def covers(outline, point):
    return cv2.pointPolygonTest(cv2.convexHull(outline.astype(np.float32)), tuple(map(float, point)), False) > 0


def test_plates_are_covered_at_both_ends_and_heads_on_top():
    pose = np.array([[1.0, 22, np.pi / 2]])
    ends = parts(CAMERA, pose, CAR, walks=False, rides=False)
    plates, _ = project(CAMERA, np.array([[1, 22 - 2.2, 0.5], [1, 22 + 2.2, 0.5], [1, 22, 3.5]]))
    assert any(covers(part[0], plates[0]) for part in ends)
    assert any(covers(part[0], plates[1]) for part in ends)
    assert not any(covers(part[0], plates[2]) for part in ends)
    (head,) = parts(CAMERA, pose, np.array([0.5, 0.5, 1.75]), walks=True, rides=False)
    places, _ = project(CAMERA, np.array([[1, 22, 1.6], [1, 22, 1.85], [1, 22, 0.4]]))
    assert [covers(head[0], place) for place in places] == [True, True, False]
    assert len(parts(CAMERA, pose, np.array([2.0, 0.8, 1.6]), walks=False, rides=True)) == 3


def test_strangers_are_remembered_by_frame():
    strangers = Strangers(CAMERA)
    hull = np.array([[10.0, 20], [30, 20], [30, 60]])
    region = Region(np.zeros(4), hull, np.zeros(3, bool), 1.0, np.zeros(4), 1.0)
    strangers.add(3, [region, region])
    strangers.add(5, [region])
    assert [len(strangers.outlines(frame)) for frame in (2, 3, 4, 5)] == [0, 2, 0, 1]
    outline = strangers.outlines(5)[0]
    assert all(covers(outline, point) for point in hull)


def test_the_annotated_video_shows_no_plate(tmp_path):
    write_scene(free_flow(4, 2, size=(480, 270)), tmp_path)

    def visfuse(*args):
        done = subprocess.run([sys.executable, "-m", "visfuse_cli", *map(str, args)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    clip, H = tmp_path / "clip.mp4", tmp_path / "H.json"
    visfuse("calibrate-homography", "--points", tmp_path / "points.csv", "--image", clip, "--out", H)
    pictures: dict[bool, list[np.ndarray]] = {}
    for blurred in (True, False):
        out = tmp_path / str(blurred)
        visfuse(
            "speed", clip, "--homography", H, "--out", out, "--no-report", "--set", f"privacy.blur={blurred}".lower()
        )
        with av.open(str(out / "annotated.mp4")) as video:
            pictures[blurred] = [frame.to_ndarray(format="gray") for frame in video.decode(video=0)]
        assert (out / "calibration.png").exists() != blurred
    track = max(json.loads((out / "tracks.json").read_text())["tracks"], key=lambda t: t["summary"]["n_frames"])
    sharp = np.array([_sharpness(pictures, state) for state in track["states"]])  # one frame may be nearly smooth
    blurred, plain = sharp.mean(axis=0)
    assert blurred < 0.92 * plain
    state = track["states"][len(track["states"]) // 2]
    assert not np.array_equal(pictures[True][state["frame"]], pictures[False][state["frame"]])


def _sharpness(pictures, state):
    """How much the lower half of a vehicle's box varies, blurred and not."""
    u, v, w, h = np.round(state["box"]["image"]).astype(int)
    low = np.s_[max(v + h // 2, 0) : v + h, max(u, 0) : u + w]
    return [cv2.Laplacian(pictures[blurred][state["frame"]], cv2.CV_32F)[low].std() for blurred in (True, False)]
