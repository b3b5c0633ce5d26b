"""The sun: its direction from the shadows beside boxes, and what geometry cuts off the foreground."""

import cv2
import numpy as np
import pytest
from masks import CAR, SIZE, labels_of, road_camera

from visfuse_cli.tracking.sun import KNOWN, Shade, Sun, shadow_picture
from visfuse_cli.vision.background import FOREGROUND, SHADOW

CAMERA = road_camera()
NOBODY = np.zeros((0, 3)), np.zeros((0, 3))


def seen(pose, per_metre, value=SHADOW):
    """Labels of one car and its shadow, as far as the car does not hide it."""
    labels = labels_of(CAMERA, [(pose, CAR)])
    labels[shadow_picture(CAMERA, pose[None], CAR[None], np.asarray(per_metre)) > 0] = value
    return labels


def watched(per_metre, value=SHADOW, vehicles=5, noise=0.0):
    rng = np.random.default_rng(3)
    sun = Sun(CAMERA)
    for number in range(vehicles):
        for k in range(3):
            pose = np.array([rng.uniform(-3, 5), 16 + 4.0 * k, np.pi / 2 + rng.normal(0, 0.05)])
            labels = labels_of(CAMERA, [(pose, CAR)]) if per_metre is None else seen(pose, per_metre, value)
            labels[rng.random(labels.shape) < noise] = FOREGROUND
            sun.look(5.0 * number + k, labels, pose[None], CAR[None], np.array([True]), [number])
    return sun.shadow


@pytest.mark.parametrize(
    ("course", "length", "value", "noise"),
    [(20, 0.7, SHADOW, 0.0), (310, 1.2, SHADOW, 0.02), (130, 2.5, FOREGROUND, 0.0), (200, 2.5, FOREGROUND, 0.03)],
)
def test_the_sun_is_found_from_shadows(course, length, value, noise):
    course = np.radians(course)
    per_metre = length * np.array([np.cos(course), np.sin(course)])
    shadow = watched(per_metre, value, noise=noise)
    assert shadow is not None
    report = shadow.report()
    off = (report["azimuth_deg"] - np.degrees(course) - 180 + 180) % 360 - 180
    assert abs(off) < 8
    assert report["elevation_deg"] == pytest.approx(np.degrees(np.arctan2(1, length)), abs=8)
    assert report["vehicles"] >= 4


def test_without_shadows_or_with_few_vehicles_no_sun_is_found():
    assert watched(None) is None
    assert watched(None, noise=0.05) is None
    assert watched((1.0, 0.5), vehicles=2) is None


def test_what_is_as_dark_as_shadows_is_cut_off_where_one_falls():
    pose, per_metre = np.array([1.0, 22, np.pi / 2]), np.array([1.5, 0.4])
    where = shadow_picture(CAMERA, pose[None], CAR[None], per_metre)
    empty = np.full((SIZE[1], SIZE[0], 3), 110, np.uint8)
    image = empty.copy()
    image[where > 0] = 30
    red = np.zeros_like(where)
    v, u = (int(np.median(axis)) for axis in np.nonzero(where))
    cv2.rectangle(red, (u - 3, v - 3), (u + 3, v + 3), 255, -1)
    image[red > 0] = (10, 10, 90)  # no shadow has a colour
    labels = labels_of(CAMERA, [(pose, CAR)])
    labels[where > 0] = FOREGROUND
    shade = Shade(0.45)
    for _ in range(KNOWN - 1):
        np.testing.assert_array_equal(shade.cut(labels, image, empty, where), labels)
    cleaned = shade.cut(labels, image, empty, where)
    assert (cleaned[(where > 0) & (red == 0)] == SHADOW).all()
    assert (cleaned[(where > 0) & (red > 0)] == FOREGROUND).all()
    np.testing.assert_array_equal(cleaned[where == 0], labels[where == 0])
    assert shade.cut(labels, image, empty, np.zeros_like(where)) is labels
    tolerant = Shade(0.2)  # colour tells these shadows already
    for _ in range(KNOWN + 1):
        assert tolerant.cut(labels, image, empty, where) is labels


def test_a_shadow_lies_beside_its_box_and_away_from_the_sun():
    pose = np.array([1.0, 22, np.pi / 2])
    right = shadow_picture(CAMERA, pose[None], CAR[None], np.array([2.0, 0.0]))
    left = shadow_picture(CAMERA, pose[None], CAR[None], np.array([-2.0, 0.0]))
    assert np.nonzero(right)[1].mean() > np.nonzero(left)[1].mean() + 50
    assert not shadow_picture(CAMERA, *NOBODY, np.array([2.0, 0.0])).any()
