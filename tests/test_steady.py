"""A camera that shakes, is knocked or covered: where it looked is found again, and what cannot be is said."""

import cv2
import numpy as np
import pytest

from visfuse_cli.records import Frame
from visfuse_cli.tracking.annotate import RED, mark_camera
from visfuse_cli.tracking.camera_watch import CameraLog, CameraWatch, Motions
from visfuse_cli.vision.exposure import Exposure, levelled
from visfuse_cli.vision.steady import Steady, at_rest, moved

SIZE = (320, 240)


def _scene(seed: int = 0) -> np.ndarray:
    """A textured picture, larger than the camera's."""
    coarse = np.random.default_rng(seed).uniform(40, 200, (60, 80, 3)).astype(np.float32)
    return cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)


def _seen(scene: np.ndarray, image_from_rest: np.ndarray, noise: float = 2.0, seed: int = 0) -> np.ndarray:
    rest_from_scene = np.array([[1, 0, -160], [0, 1, -120], [0, 0, 1.0]])
    picture = cv2.warpPerspective(scene, image_from_rest @ rest_from_scene, SIZE, flags=cv2.INTER_CUBIC)
    return np.clip(picture + np.random.default_rng(seed).normal(0, noise, picture.shape), 0, 255).astype(np.uint8)


def _turned(angle: float, u: float, v: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, u], [s, c, v], [0, 0, 1]])


CORNERS = np.array([[0.0, 0], [319, 0], [0, 239], [319, 239]])


@pytest.mark.parametrize(
    "motion",
    [
        np.eye(3),
        _turned(0, 1.7, -2.3),
        _turned(0.01, -1.0, 0.4),
        _turned(0, 31.0, -18.0),
        np.array([[1.02, 0.01, 9], [-0.01, 1.01, -7], [3e-5, -2e-5, 1]]),
    ],
)
def test_the_camera_is_found_again(motion: np.ndarray):
    scene = _scene()
    found = Steady(_seen(scene, np.eye(3))).register(_seen(scene, motion, seed=1))
    assert found is not None
    np.testing.assert_allclose(moved(found, CORNERS), moved(motion, CORNERS), atol=0.25)


def test_vehicles_over_a_third_of_the_picture_do_not_pull():
    scene = _scene()
    picture = _seen(scene, _turned(0, 1.5, 0.5), seed=1)
    picture[40:200, 60:220] = _seen(_scene(5), np.eye(3))[40:200, 60:220]
    found = Steady(_seen(scene, np.eye(3))).register(picture)
    assert found is not None
    np.testing.assert_allclose(moved(found, CORNERS), CORNERS + [1.5, 0.5], atol=0.3)


def test_another_scene_is_not_recognised():
    assert Steady(_seen(_scene(), np.eye(3))).register(_seen(_scene(9), np.eye(3))) is None


def test_a_scene_without_contrast_counts_as_steady():
    grey = np.full((*SIZE[::-1], 3), 128, np.uint8)
    np.testing.assert_array_equal(Steady(grey).register(grey), np.eye(3))


@pytest.mark.parametrize(
    "motion", [_turned(0.004, 2.4, -1.6), _turned(0, 2.4, -1.6), _turned(0, -0.7, 3.0), _turned(0, -2.0, -0.3)]
)
def test_a_picture_laid_back_equals_the_one_at_rest(motion: np.ndarray):
    scene = _scene()
    steady = Steady(_seen(scene, np.eye(3), noise=0))
    back = steady.laid_back(_seen(scene, motion, noise=0), motion)
    error = np.abs(back.astype(int) - _seen(scene, np.eye(3), noise=0))
    assert error[8:-8, 8:-8].mean() < 1.0
    assert error.mean() < 1.5  # the rim is filled from the reference


def test_pictures_are_laid_over_one_another_at_their_middle():
    scene = _scene()
    shifts = [3.0, -1.0, 0.0, 1.0, -2.0]
    rested, shake = at_rest(_seen(scene, _turned(0, shift, 0), noise=0) for shift in shifts)
    assert abs(shake - np.median(np.abs(shifts))) < 0.2
    middle = _seen(scene, _turned(0, 0.0, 0), noise=0).astype(int)
    for picture in rested:
        assert np.abs(picture.astype(int) - middle)[8:-8, 8:-8].mean() < 1.5


def _watched(motions: list[np.ndarray | None], fps: float = 25.0) -> tuple[CameraLog, Motions]:
    scene = _scene()
    watch, remembered = CameraWatch(_seen(scene, np.eye(3))), Motions()
    covered = np.full((*SIZE[::-1], 3), 20, np.uint8)
    for index, motion in enumerate(motions):
        image = covered if motion is None else _seen(scene, motion, seed=index)
        steadied = watch.steadied(Frame("image", index, index / fps, image))
        if steadied is not None:
            remembered.note(steadied)
    return watch.log, remembered


@pytest.mark.parametrize("knocked", [5, 8, 17])
def test_a_knock_while_the_scene_is_learnt_does_not_move_where_the_camera_rests(knocked: int):
    rng = np.random.default_rng(5)
    pictures = [
        _seen(_scene(), _turned(0, *(rng.normal(0, 0.8, 2) + ([9, -6] if k >= knocked else [0, 0]))), seed=k)
        for k in range(22)
    ]
    laid = np.median(at_rest(pictures)[0], axis=0).astype(np.uint8)
    place = Steady(_seen(_scene(), np.eye(3))).register(laid)
    assert place is not None
    assert np.hypot(*place[:2, 2]) < 1.0


def test_a_quiet_camera_is_left_alone():
    log, remembered = _watched([np.eye(3)] * 60)
    assert log.report() == {
        "shake_px": pytest.approx(0, abs=0.1),
        "moves": [],
        "not_measured": [],
        "exposure_gain": [1.0, 1.0],
    }
    assert log.warnings("a.mp4") == []
    assert remembered.image_from_rest(30) is None


def test_shake_is_measured_and_remembered():
    rng = np.random.default_rng(3)
    motions = [_turned(0, *rng.normal(0, 1.5, 2)) for _ in range(100)]
    log, remembered = _watched(motions)
    assert log.report()["shake_px"] == pytest.approx(1.5, rel=0.25)
    assert log.report()["moves"] == []
    assert any("shakes by 1." in line for line in log.warnings("a.mp4"))
    found = remembered.image_from_rest(40)
    assert found is not None
    np.testing.assert_allclose(moved(found, CORNERS), moved(motions[40], CORNERS), atol=0.3)


def test_a_knock_is_reported_once_with_its_time():
    log, _ = _watched([np.eye(3)] * 75 + [_turned(0, 12.0, -5.0)] * 100)
    (move,) = log.report()["moves"]
    assert move["t"] == pytest.approx(3.0, abs=0.21)
    assert move["px"] == pytest.approx(13.0, abs=0.5)
    assert "calibrate again" in log.warnings("a.mp4")[-1]


def test_a_darker_exposure_is_brought_back():
    picture = _seen(_scene(), np.eye(3))
    darker = np.rint(picture * [0.7, 0.75, 0.8]).astype(np.uint8)
    darker[:100] = 250  # a white lorry over two fifths of the picture
    gain = Exposure(picture).gain(darker)
    np.testing.assert_allclose(gain, [1 / 0.7, 1 / 0.75, 1 / 0.8], rtol=0.02)
    assert np.abs(levelled(darker, gain)[100:].astype(int) - picture[100:]).mean() < 1.5
    assert levelled(picture, Exposure(picture).gain(picture)) is picture


def test_darkness_has_no_gain():
    np.testing.assert_array_equal(
        Exposure(_seen(_scene(), np.eye(3))).gain(np.zeros((240, 320, 3), np.uint8)), np.ones(3)
    )


def test_a_covered_camera_is_not_measured():
    log, _ = _watched([np.eye(3)] * 30 + [None] * 25 + [np.eye(3)] * 30)
    ((first, last),) = log.report()["not_measured"]
    assert first == pytest.approx(1.2, abs=0.21)  # a quiet camera is looked at every fifth frame
    assert last == pytest.approx(54 / 25)
    assert log.was_lost(2.0)
    assert not log.was_lost(2.5)
    assert "could not be recognised for 0.96 s, first at 1.20 s" in log.warnings("a.mp4")[0]


def test_the_video_says_what_is_known_of_the_camera():
    log = CameraLog()
    log.lost.append([2.0, 3.0])
    log.moves.append({"t": 5.0, "px": 9.0})
    red, written = [], []
    for t in (1.0, 2.5, 6.0):
        picture = np.zeros((360, 640, 3), np.uint8)
        mark_camera(Frame("image", 0, t, picture), log)
        red.append(bool((picture[0, 320] == RED).all()))
        written.append(int(np.flatnonzero((picture[325:353, 6:630] > 90).any(axis=(0, 2))).max()))
    assert red == [False, True, False]
    assert written[1] > written[0] + 100
    assert written[2] > written[0] + 100
