"""The search for a box's outline in a picture of labels, against boxes drawn exactly."""

import cv2
import numpy as np
import pytest
from masks import CAR, TRUCK, evidence_of, labels_of, road_camera

from visfuse_cli.tracking import measure
from visfuse_cli.tracking.evidence import BoxEvidence, LabelEvidence
from visfuse_cli.tracking.settings import PoseSettings
from visfuse_cli.vision import contour, regions, wireframe
from visfuse_cli.vision.background import FOREGROUND, SHADOW

CAMERA = road_camera()
POSE = np.array([2.0, 22.0, 1.4])
NOBODY = np.zeros((0, 3)), np.zeros((0, 3))


def search(labels, pose=POSE, size=CAR, reach=16.0, taken=NOBODY):
    return evidence_of(CAMERA, labels).probe(pose[None], size[None], np.array([reach]), taken)


def fitted(look, pose, size=CAR):
    return measure.fit_poses(CAMERA, look.outlines, pose[None], size, np.full(3, 0.01), PoseSettings())


def test_an_outline_is_found_where_it_is_though_expected_elsewhere():
    look = search(labels_of(CAMERA, [(POSE, CAR)]), POSE + [0.25, 0.4, 0.03])
    assert look.border[0] > 0.8
    found = fitted(look, POSE + [0.25, 0.4, 0.03])
    np.testing.assert_allclose(found.pose[0, :2], POSE[:2], atol=0.12)


def test_shares_tell_a_box_from_the_empty_road_and_from_a_shadow():
    seen = search(labels_of(CAMERA, [(POSE, CAR)]), reach=6.0)
    nothing = search(labels_of(CAMERA, []))
    shade = search(labels_of(CAMERA, [], [(POSE, CAR)]), reach=6.0)
    assert min(seen.border[0], seen.moved[0], seen.paint[0], seen.open[0]) > 0.95
    assert (nothing.border[0], nothing.moved[0], nothing.paint[0]) == (0, 0, 0)
    assert shade.moved[0] > 0.95
    assert shade.paint[0] == 0


def test_what_stands_in_front_hides_the_outline_and_lends_none():
    truck = POSE - [0.6, 8.0, 0.0]
    labels = labels_of(CAMERA, [(POSE, CAR), (truck, TRUCK)])
    look = search(labels, taken=(truck[None], TRUCK[None]))
    assert look.open[0] < 0.7
    hidden = contour.owners(CAMERA, truck[None], TRUCK[None])
    valid = look.outlines.valid[0]
    middle = (
        look.outlines.support[0][:, None] * look.outlines.normal[0]
    )  # feet of the tangents, not points: unused rows
    assert valid.sum() < 24
    assert len(middle) == len(valid)
    assert hidden.any()


def test_a_box_wholly_hidden_says_nothing():
    bus = POSE - [0.5, 5.0, 0.0]
    size = np.array([4.0, 4.0, 6.0])
    look = search(labels_of(CAMERA, [(bus, size)]), taken=(bus[None], size[None]))
    assert look.open[0] < 0.1
    assert np.isnan(look.moved[0])


def test_the_shadow_that_a_vehicle_stands_in_is_not_part_of_it():
    shade = [(POSE - [0.0, 0.5, 0.0], CAR * [1.2, 1.3, 0.05])]
    look = search(labels_of(CAMERA, [(POSE, CAR)], shade), POSE + [0.0, -0.4, 0.0])
    found = fitted(look, POSE + [0.0, -0.4, 0.0])
    np.testing.assert_allclose(found.pose[0, :2], POSE[:2], atol=0.15)
    assert look.clear[0] > 0.7


def test_grey_paint_taken_for_shadow_still_ends_the_vehicle():
    labels = labels_of(CAMERA, [(POSE + [0.0, 0.3, 0.0], CAR * 0.5)], [(POSE, CAR)])
    look = search(labels, POSE + [0.2, 0.2, 0.0], reach=8.0)
    found = fitted(look, POSE + [0.2, 0.2, 0.0])
    np.testing.assert_allclose(found.pose[0, :2], POSE[:2], atol=0.2)


def test_owners_are_the_nearest_boxes():
    behind, front = POSE, POSE - [0.0, 7.0, 0.0]
    mask = contour.owners(CAMERA, np.stack([behind, front]), np.stack([TRUCK, CAR]))
    alone = contour.owners(CAMERA, behind[None], TRUCK[None])
    near = contour.owners(CAMERA, front[None], CAR[None])
    assert set(np.unique(mask)) == {0, 1, 2}
    assert (mask[near == 1] == 2).all()
    assert (mask[(alone == 1) & (near == 0)] == 1).all()


def test_packed_evidence_is_the_same_evidence():
    labels = labels_of(CAMERA, [(POSE, CAR)], [(POSE + [1.0, 0, 0], CAR)])
    assert set(np.unique(labels)) == {0, SHADOW, FOREGROUND}
    evidence = evidence_of(CAMERA, labels)
    before = evidence.probe(POSE[None], CAR[None], np.array([9.0]), NOBODY)
    evidence.pack()
    after = evidence.probe(POSE[None], CAR[None], np.array([9.0]), NOBODY)
    np.testing.assert_array_equal(before.outlines.support, after.outlines.support)
    np.testing.assert_array_equal(before.paint, after.paint)


def test_leftovers_are_what_no_box_explains():
    other = np.array([-3.0, 30.0, 1.5])
    evidence = evidence_of(CAMERA, labels_of(CAMERA, [(POSE, CAR), (other, CAR)]))
    assert len(evidence.leftovers(*NOBODY)) == 2
    (left,) = evidence.leftovers(POSE[None], CAR[None])
    hull = wireframe.silhouette(CAMERA, other, CAR)
    np.testing.assert_allclose(left.box[:2], hull.min(axis=0), atol=3)
    assert evidence.leftovers(np.stack([POSE, other]), np.stack([CAR, CAR])) == []


@pytest.mark.parametrize("lift", [0.0, 40.0])
def test_a_detection_is_given_to_the_box_it_lies_on(lift):
    hull = wireframe.silhouette(CAMERA, POSE, CAR)
    low, high = hull.min(axis=0), hull.max(axis=0)
    box = regions.from_box(np.array([*(low - [0, lift]), *(high - low)]), 0.9, (1280, 720))
    evidence = BoxEvidence([box], CAMERA)
    look = evidence.look(POSE[None], CAR[None], np.array([20.0]))
    assert look.outlines.valid[0].sum() == 4
    found = fitted(look, POSE)
    assert found.ok[0]
    if not lift:
        np.testing.assert_allclose(found.pose[0, :2], POSE[:2], atol=0.1)
    assert evidence.leftovers(POSE[None], CAR[None]) == []
    assert evidence.leftovers(POSE[None] + [4.0, 9.0, 0.0], CAR[None]) == [box]


def test_boxes_behind_the_camera_are_nobodys():
    front, behind = np.array([0.0, 20, np.pi / 2]), np.append(3 * CAMERA.centre[:2] - [0, 60], np.pi / 2)
    with np.errstate(all="raise"):
        mask = contour.owners(CAMERA, np.stack([behind, front]), np.stack([CAR, CAR]))
    assert np.isnan(wireframe.projected(CAMERA, behind[None], CAR[None])).any()
    assert np.unique(mask).tolist() == [0, 2]


def test_a_box_that_is_too_short_is_looked_for_further_out():
    labels = labels_of(CAMERA, [(POSE, TRUCK)])
    short = TRUCK - [1.6, 0, 0]
    pose = POSE - [0.8 * np.cos(POSE[2]), 0.8 * np.sin(POSE[2]), 0]  # its rear is where it should be
    evidence = evidence_of(CAMERA, labels)
    alone = evidence.probe(pose[None], short[None], np.array([4.0]), NOBODY)
    followed = evidence.look(pose[None], short[None], np.array([4.0]))
    assert followed.outlines.valid.sum() > alone.outlines.valid.sum()
    np.testing.assert_array_equal(followed.border, alone.border)  # what was not expected there is no border found
    belief = short, np.array([0.8, 0.1, 0.1])
    fit = measure.fit_poses(CAMERA, followed.outlines, pose[None], *belief, PoseSettings())
    assert fit.size[0, 0] > short[0] + 0.6


def test_where_it_is_sunny_a_shadow_is_no_end_of_a_vehicle():
    shade = POSE + [0.5, -0.3, 0.0]
    labels = labels_of(CAMERA, [(POSE, CAR)], [(shade, CAR)])
    within = cv2.erode((labels == FOREGROUND).astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    labels[within & (np.arange(labels.shape[0]) % 4 > 0)[:, None]] = 0  # grey paint on a grey road
    apart = POSE + [0.4, -0.25, 0.0]
    found = []
    for sunny in (False, True):
        evidence = LabelEvidence(labels, CAMERA, regions.bands(CAMERA), 0.3, 0.12, 0.5, sunny=sunny)
        found.append(fitted(evidence.look(apart[None], CAR[None], np.array([24.0])), apart).pose[0, :2])
    off = np.linalg.norm(np.array(found) - POSE[:2], axis=1)
    assert off[1] < 0.15
    assert off[1] < off[0]
