"""Night: light without a body gives no row and a reason, a body that is lit stays."""

import subprocess
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from masks import CAR, SIZE, road_camera

from samples.night import write_night
from samples.road import free_flow
from samples.score import rows
from visfuse_cli.records import Frame
from visfuse_cli.tracking.headlights import REASON, Headlights, steepness
from visfuse_cli.vision.wireframe import silhouette

CAMERA = road_camera()
POSE = np.array([1.0, 22.0, np.pi / 2])
HULL = silhouette(CAMERA, POSE, CAR)


def scene(grey):
    return np.full((SIZE[1], SIZE[0], 3), grey, np.uint8)


def painted(picture, colour, soft=0.0, window=None):
    mask = np.zeros(picture.shape[:2], np.float32)
    cv2.fillConvexPoly(mask, np.round(HULL).astype(np.int32), 1.0)
    if soft:
        mask = cv2.GaussianBlur(mask, (0, 0), soft)
    out = picture * (1 - mask[..., None]) + colour * mask[..., None]
    if window is not None:
        u, v = HULL.mean(axis=0).astype(int)
        out[v - 18 : v + 2, u - 25 : u + 25] = window
    return out.round().astype(np.uint8)


def judged(empty, picture):
    lamps = Headlights(empty, CAMERA)
    step = SimpleNamespace(posterior=SimpleNamespace(mean=POSE[:2]))
    track = SimpleNamespace(id=7, samples=[SimpleNamespace(measured=True)], steps=[step], size=CAR)
    for index in range(0, 12, 3):
        lamps.look(Frame("image", index, index / 25, picture), [track], [POSE[2]])
    return lamps.only_light(7)


def test_a_pool_of_light_is_no_body_and_a_lit_body_is():
    dark = scene(25)
    assert judged(dark, painted(dark, 120.0, soft=14))
    assert not judged(dark, painted(dark, 120.0, window=6))  # a white van with its windows
    assert not judged(dark, painted(dark, 8.0))  # a dark car under a lamp
    assert judged(scene(2), painted(scene(2), 90.0))  # nothing can be darker than black: no body is told from light
    assert not judged(scene(100), painted(scene(100), 220.0, soft=14))  # by day light makes no vehicle


def test_how_steep_a_border_is():
    sharp, soft = (cv2.cvtColor(painted(scene(20), 120.0, s), cv2.COLOR_BGR2GRAY).astype(float) for s in (0.0, 8.0))
    assert steepness(sharp, HULL) > 0.9
    assert steepness(soft, HULL) < 0.6
    assert steepness(np.full(SIZE[::-1], 20.0), HULL) == 1


@pytest.mark.parametrize("seed", [4])
def test_nothing_is_measured_in_the_dark(seed, tmp_path):
    write_night(free_flow(seed, 3, (480, 270)), tmp_path, ambient=0.02)

    def visfuse(*args):
        done = subprocess.run([sys.executable, "-m", "visfuse_cli", *map(str, args)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    visfuse("calibrate-homography", "--points", tmp_path / "points.csv", "--out", tmp_path / "H.json")
    options = ("--homography", tmp_path / "H.json", "--out", tmp_path / "run", "--no-video", "--no-report")
    visfuse("speed", tmp_path / "clip.mp4", *options)
    assert rows(tmp_path / "run" / "speeds.csv") == []
    reasons = [row["reason"] for row in rows(tmp_path / "run" / "rejected.csv")]
    assert REASON in reasons
