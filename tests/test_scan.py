"""Vehicles found inside of one region, by the courses of the corners on them."""

import cv2
import numpy as np
import pytest
from masks import CAR, SIZE, TRUCK, evidence_of, labels_of, road_camera

from visfuse_cli.maths.angles import wrap
from visfuse_cli.maths.cameras import project
from visfuse_cli.tracking.association import footprint_overlap
from visfuse_cli.tracking.scan import headings, scan, velocity_of
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.vision.points import Courses, MovingPoints

CAMERA = road_camera()
NOBODY = np.zeros((0, 3)), np.zeros((0, 3))
ALONG = 1.5  # rad
VAN = np.array([5.2, 2.0, 2.2])


def queue():
    """A car, a truck right behind it and a van beside that: one region."""
    way, aside = np.array([np.cos(ALONG), np.sin(ALONG)]), np.array([np.sin(ALONG), -np.cos(ALONG)])
    first = np.array([2.0, 22.0])
    places = [first, first + 9.5 * way, first + 7 * way + 2.6 * aside]
    return [(np.append(place, ALONG), size) for place, size in zip(places, (CAR, TRUCK, VAN), strict=True)]


def test_each_vehicle_of_a_queue_is_found_though_they_are_one_region():
    boxes = queue()
    evidence = evidence_of(CAMERA, labels_of(CAMERA, boxes))
    (region,) = evidence.leftovers(*NOBODY)
    pose, size = NOBODY
    for _ in boxes:
        guesses = scan(CAMERA, TrackerSettings(), evidence, region.box, region.around_area, ALONG, (pose, size))
        best = max(guesses, key=lambda guess: guess.gain)
        pose, size = np.vstack([pose, best.pose]), np.vstack([size, best.size])
    off = np.linalg.norm(pose[:, None, :2] - np.array([box[0][:2] for box in boxes]), axis=2)
    assert sorted(off.argmin(axis=1)) == [0, 1, 2]
    assert off.min(axis=1).max() < 1.0


def test_corners_tell_the_course_and_keep_it_when_they_stand():
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.integers(0, 256, (SIZE[1], SIZE[0])).astype(np.uint8), (0, 0), 2)
    points = MovingPoints(CAMERA)
    start, course, speed = np.array([2.0, 22.0]), 1.2, 8.0
    for k in range(40):
        way = speed * min(k, 25) / 25.0  # it stands after a second
        place = start + way * np.array([np.cos(course), np.sin(course)])
        now, then = (project(CAMERA, np.append(p, 0.0)[None])[0][0] for p in (place, start))
        move = np.array([[1.0, 0.0, now[0] - then[0]], [0.0, 1.0, now[1] - then[1]]])
        picture = cv2.warpAffine(texture, move, SIZE)
        mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        cv2.circle(mask, tuple(int(x) for x in now), 20, 255, -1)
        found = points.follow(picture, k / 25.0, mask).courses
    assert len(found.course) >= 3
    assert np.abs(wrap(np.median(found.course) - course)) < 0.1
    assert np.median(np.linalg.norm(found.velocity, axis=1)) < 2.0


def test_courses_are_gathered_and_a_box_takes_the_speed_of_its_own_corners():
    course = np.array([1.5, 1.45, 1.55, -1.6, -1.7, 0.2])
    assert headings(course) == pytest.approx([1.5, -1.65], abs=0.06)
    (pose, size), *_ = queue()
    evidence = evidence_of(CAMERA, labels_of(CAMERA, [(pose, size)]))
    (region,) = evidence.leftovers(*NOBODY)
    (guess, *_) = scan(CAMERA, TrackerSettings(), evidence, region.box, region.around_area, ALONG, NOBODY)
    middle = project(CAMERA, np.array([[*pose[:2], 0.7]]))[0]
    velocity = 5.0 * np.array([[np.cos(ALONG), np.sin(ALONG)]])
    there = Courses(np.tile(middle, (3, 1)), np.tile(velocity, (3, 1)), np.full(3, ALONG))
    assert velocity_of(CAMERA, guess, there) == pytest.approx(velocity[0] * (1 - guess.size[2] / 2 / 7.5), rel=0.05)
    assert velocity_of(CAMERA, guess, Courses(there.place, there.velocity, there.course + 1.5)) is None


def test_footprints_overlap_as_the_smaller_lies_in_the_larger():
    car, truck = np.array([[0.0, 0.0, 0.3]]), np.array([[0.5, 0.2, 0.3], [0.0, 30.0, 0.3], [-1.6, 4.0, 0.3]])
    share = footprint_overlap(car, CAR[None], truck, np.tile(TRUCK, (3, 1)))
    assert share.shape == (1, 3)
    assert share[0, 0] > 0.9
    assert share[0, 1] == share[0, 2] == 0
