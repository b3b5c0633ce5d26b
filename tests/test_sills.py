"""What is beneath a vehicle's paint: told from the sun's shadow by the side it is on, or seen again below a gap."""

import cv2
import numpy as np
from masks import CAR, drive, evidence_of, labels_of, road_camera

from visfuse_cli.maths.cameras import project
from visfuse_cli.tracking import measure, sills
from visfuse_cli.tracking.conclude import conclude
from visfuse_cli.tracking.ground import GroundTracker
from visfuse_cli.tracking.settings import PoseSettings, TrackerSettings
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.background import FOREGROUND
from visfuse_cli.vision.wireframe import Outlines

CAMERA = road_camera()
POSES = np.array([[2.0 + 0.02 * k, 20.0 + k, np.pi / 2] for k in range(8)])
NOBODY = np.zeros((0, 3)), np.zeros((0, 3))
SILL_M = 0.25
AWAY, NEARER = np.array([0.1, 4.0]), np.array([0.1, -4.0])  # where shadows fall: the sun behind the camera, and before


def fill_above(labels, pose, height, label):
    """Draw a car but for what is lower."""
    box = wireframe.corners(pose, CAR)
    box[:4, 2] = height
    hull = cv2.convexHull(project(CAMERA, box)[0].astype(np.float32))
    cv2.fillConvexPoly(labels, np.round(hull * 16).astype(np.int32), label, shift=4)


def sight(pose, shade=()):
    """Labels of a car whose lowest part looks like shadow."""
    labels = labels_of(CAMERA, [], [*shade, (pose, CAR)])
    fill_above(labels, pose, SILL_M, FOREGROUND)
    return labels


def gap(pose, bumper=True):
    """Labels of a car of which a band looks like the road, and, if it has one, a bumper below that does not."""
    labels = labels_of(CAMERA, [(pose, CAR)] if bumper else [])
    fill_above(labels, pose, 0.12, 0)
    fill_above(labels, pose, SILL_M, FOREGROUND)
    return labels


def seen(shade=(), draw=None):
    """The outlines of a car that was taken for what is painted of it, and its poses then: further away."""
    poses, looks = [], []
    for pose in POSES:
        back = pose.copy()
        back[:2] += (pose[:2] - CAMERA.centre[:2]) * SILL_M / CAMERA.centre[2]
        labels = draw(pose) if draw else sight(pose, [(pose + off, size) for off, size in shade])
        look = evidence_of(CAMERA, labels).probe(back[None], (CAR - [0, 0, SILL_M])[None], np.array([5.0]), NOBODY)
        poses.append(back)
        looks.append(look)
    return Outlines.joined([look.outlines for look in looks]), np.array(poses)


def lowered(outlines, poses, fall):
    return sills.on_the_ground(outlines, np.ones(len(poses), bool), CAMERA, poses, CAR - [0, 0, SILL_M], fall)


def astray(outlines, poses):
    """How much further away (m) than the car boxes are that are fitted to outlines."""
    fit = measure.fit_poses(CAMERA, outlines, poses, CAR, np.full(3, 0.01), PoseSettings())
    return np.median(fit.pose[:, 1] - POSES[:, 1])


def test_what_is_dark_on_the_sunny_side_is_the_vehicles_own():
    outlines, poses = seen()
    told = outlines.dark[np.isfinite(outlines.dark)]
    np.testing.assert_allclose(np.median(told), SILL_M, atol=0.04)
    assert astray(outlines, poses) > 0.3
    assert abs(astray(lowered(outlines, poses, AWAY), poses)) < 0.15


def test_the_same_on_the_side_that_lies_in_shade_may_be_a_shadow():
    outlines, poses = seen()
    assert lowered(outlines, poses, NEARER) is outlines


def test_a_shadow_goes_on_for_longer_than_sills_are_high():
    outlines, poses = seen([(np.array([0.0, -4.0, 0.0]), np.array([9.0, 4.0, 0.01]))])
    assert np.isinf(outlines.dark).sum() > 2 * np.isfinite(outlines.dark).sum()
    assert lowered(outlines, poses, AWAY) is outlines


def test_a_rim_of_uneven_height_is_no_sill():
    outlines, poses = seen()
    rng = np.random.default_rng(0)
    outlines.dark[:] = np.where(np.isnan(outlines.dark), np.nan, rng.uniform(0.03, 0.6, outlines.dark.shape))
    assert lowered(outlines, poses, AWAY) is outlines


def test_paint_down_to_the_ground_has_nothing_dark_beneath():
    evidence = evidence_of(CAMERA, labels_of(CAMERA, [(POSES[0], CAR)]))
    look = evidence.probe(POSES[:1], CAR[None], np.array([8.0]), NOBODY)
    assert np.isnan(look.outlines.dark).all()


def test_a_bumper_below_a_gap_is_the_vehicles_own():
    outlines, poses = seen(draw=gap)
    assert astray(outlines, poses) > 0.3
    assert abs(astray(lowered(outlines, poses, None), poses)) < 0.15
    assert lowered(*(without := seen(draw=lambda pose: gap(pose, bumper=False))), None) is without[0]


def test_a_car_in_low_sun_is_as_fast_as_it_is():
    truth = drive((-1, 14), (0.4, 9), np.arange(60) / 25)
    tracker, tracks = GroundTracker(CAMERA, TrackerSettings()), []
    for k, pose in enumerate(truth):
        tracker.predict(k / 25)
        tracks += tracker.update(k, evidence_of(CAMERA, sight(pose)))[0]
    (track,) = tracks + tracker.finish()[0]

    def speed(fall):
        (path,) = conclude([track], CAMERA, tracker.settings, tracker.dynamics, fall)
        end = path.planar.mean[[8, -8], 1]
        return (end[1] - end[0]) / (path.t[-8] - path.t[8])

    assert speed(None) > 9 * (1 + 0.7 * SILL_M / CAMERA.centre[2])
    np.testing.assert_allclose(speed(AWAY), 9.0, rtol=0.01)
