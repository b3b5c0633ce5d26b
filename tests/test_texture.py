"""How fast boxes go by the corners on them, and tracks that go on in others."""

import numpy as np
import pytest
from masks import CAR, TRUCK, evidence_of, labels_of, road_camera

from visfuse_cli.maths.cameras import project
from visfuse_cli.tracking import dynamics as dynamics_tools
from visfuse_cli.tracking import texture
from visfuse_cli.tracking.evidence import LabelEvidence
from visfuse_cli.tracking.ground import GroundTracker
from visfuse_cli.tracking.joining import goes_on, part_before
from visfuse_cli.tracking.settings import VEHICLES, FilterSettings, TargetSettings, TrackerSettings
from visfuse_cli.tracking.targets import Sample, Track
from visfuse_cli.vision import regions
from visfuse_cli.vision.points import Corners, Courses, Moves
from visfuse_cli.vision.wireframe import silhouette, tangents

CAMERA = road_camera()
DT = 0.04


def on_near_side(pose, size, rng, count=12):
    """Points (count, 3) m on the side of a box that faces the camera, which looks along +Y."""
    local = np.column_stack(
        [np.full(count, -size[0] / 2), rng.uniform(-0.4, 0.4, count) * size[1], rng.uniform(0.3, 0.9, count) * size[2]]
    )
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.column_stack([local[:, :2] @ np.array([[c, s], [-s, c]]) + pose[:2], local[:, 2]])


def moves_of(points, velocity):
    before, _ = project(CAMERA, points - np.append(velocity, 0) * DT)
    now, _ = project(CAMERA, points)
    return Moves(before, now, DT)


@pytest.mark.parametrize("speed", [-3.0, 0.0, 2.0, 12.0])
def test_corners_tell_the_speed_of_the_box_that_they_are_on(speed):
    pose = np.array([[1.0, 24.0, np.pi / 2 - 0.1]])
    along = np.array([np.cos(pose[0, 2]), np.sin(pose[0, 2])])
    moves = moves_of(on_near_side(pose[0], CAR, np.random.default_rng(1)), speed * along)
    pace, sigma = texture.paces(CAMERA, pose, CAR[None], np.zeros(1), moves)
    assert pace[0] == pytest.approx(speed, abs=0.02)
    assert texture.SETTLED <= sigma[0] < texture.SETTLED + texture.SURFACE * abs(speed) + 0.5


def test_a_box_turned_wrongly_and_a_few_corners_that_stand_do_little_harm():
    pose = np.array([[1.0, 24.0, np.pi / 2]])
    points = on_near_side(pose[0], CAR, np.random.default_rng(2))
    moves = moves_of(points, np.array([0.0, 6.0]))
    moves.before[:3] = moves.now[:3]
    pace, _ = texture.paces(CAMERA, pose + [0.0, 0.0, 0.4], CAR[None], np.full(1, 6.0), moves)
    assert pace[0] == pytest.approx(6.0 * np.cos(0.4), rel=0.1)


def test_corners_where_a_box_meets_what_stands_do_not_hold_it_back():
    pose = np.array([[1.0, 16.0, np.pi / 2]])
    moves = moves_of(on_near_side(pose[0], TRUCK, np.random.default_rng(5)), np.array([0.0, 5.0]))
    hull = silhouette(CAMERA, pose[0], TRUCK)
    border = hull + 0.02 * (hull.mean(axis=0) - hull)
    border = np.concatenate([border + share * (np.roll(border, 1, axis=0) - border) for share in (0.0, 0.3, 0.6)])
    both = Moves(np.concatenate([moves.before, border]), np.concatenate([moves.now, border]), DT)
    assert len(border) > len(moves.now)
    pace, _ = texture.paces(CAMERA, pose, TRUCK[None], np.full(1, 5.0), both)
    assert pace[0] == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize("seconds", [0.1, 0.6])
def test_a_box_that_the_corners_on_it_leave_goes_with_them(seconds):
    place = np.array([1.0, 20.0, np.pi / 2])
    dynamics, track = track_along(1, range(20), np.tile(place, (20, 1)))
    tracker = GroundTracker(CAMERA, TrackerSettings(target=TargetSettings(classes=VEHICLES)))
    tracker.tracks = [track]
    labels = labels_of(CAMERA, [(place, CAR)])  # what stood beside it keeps the place where it was filled
    nowhere = Courses(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    for frame in range(20, 20 + round(seconds / DT)):
        tracker.predict(frame * DT)
        (pose,), _ = tracker.expected()
        points = on_near_side(pose, CAR, np.random.default_rng(frame))
        corners = Corners(moves_of(points, np.array([0.0, 4.0])), nowhere)
        seen = LabelEvidence(labels, CAMERA, regions.bands(CAMERA), 0.3, 0.12, 0.5, corners=corners)
        tracker.update(frame, seen)
    (left,) = (each for each in tracker.tracks if each.id == 1)
    speed = dynamics.planar(left.steps[-1].posterior.mean)[0][3]
    assert speed < 0.5 if seconds < 0.3 else speed > 2.5


def test_corners_belong_to_the_box_in_front_and_few_tell_nothing():
    near, far = np.array([0.0, 20.0, np.pi / 2]), np.array([0.0, 30.0, np.pi / 2])
    rng = np.random.default_rng(3)
    moves = moves_of(on_near_side(near, TRUCK, rng), np.array([0.0, 4.0]))
    pace, sigma = texture.paces(CAMERA, np.stack([far, near]), np.stack([CAR, TRUCK]), np.zeros(2), moves)
    assert np.isnan([pace[0], sigma[0]]).all()
    assert pace[1] == pytest.approx(4.0, abs=0.05)
    few = Moves(moves.before[: texture.LEAST - 1], moves.now[: texture.LEAST - 1], DT)
    assert np.isnan(texture.paces(CAMERA, near[None], TRUCK[None], np.zeros(1), few)[0]).all()


@pytest.mark.parametrize("kind", ["fading", "fading-cuf", "imm"])
def test_a_speed_is_taken_in_unless_it_is_beyond_belief(kind):
    dynamics = dynamics_tools.for_target(TargetSettings(), FilterSettings(kind=kind))
    along = np.array([0.0, 1.0])
    step = dynamics_tools.first(dynamics, dynamics.begin(np.array([0.0, 20.0, np.pi / 2]), 5 * along))
    taken = dynamics_tools.take_speed(dynamics, step, along, 6.0, 0.3)
    velocity, J = dynamics.planar(taken.posterior.mean)
    variance = (J @ taken.posterior.cov @ J.T)[3, 3]
    assert velocity[3] == pytest.approx(6.0, abs=0.1)
    assert variance < 0.3**2
    assert np.array_equal(taken.prior.mean, step.prior.mean)
    assert dynamics_tools.take_speed(dynamics, step, along, 60.0, 0.3) is step


def track_along(identity, frames, place):
    """A track with the poses `place` (n, 3) at 25 frames/s, seen wholly in every one, in no hurry to be elsewhere."""
    dynamics = dynamics_tools.for_target(TargetSettings(), FilterSettings())
    outline = tangents(np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 9.0]]), np.zeros(4, dtype=bool))
    speed = 25 * np.diff(place[:, :2], axis=0, append=place[-1:, :2] * 2 - place[-2:-1, :2])
    steps = [
        dynamics_tools.first(dynamics, dynamics.begin(pose, velocity))
        for pose, velocity in zip(place, speed, strict=True)
    ]
    samples = [Sample(frame, frame / 25, outline, 1.0, True) for frame in frames]
    return dynamics, Track(identity, VEHICLES[0], CAR, np.full(3, 0.1), samples, steps, samples[-1].t)


def straight(frames, x=0.0):
    return np.array([[x, 20 + 0.2 * frame, np.pi / 2] for frame in frames])


def test_a_track_goes_on_in_one_that_began_where_it_was_whatever_it_did_after():
    strays = straight(range(50))
    strays[30:, 0] += 0.3 * np.arange(20)  # it slides off to the side
    dynamics, old = track_along(1, range(50), strays)
    _, young = track_along(2, range(28, 60), straight(range(28, 60)))
    samples, place = part_before(old, dynamics, young.samples, straight(range(28, 60)), CAR)
    assert [sample.frame for sample in samples] == list(range(28))
    np.testing.assert_allclose(place, strays[:28], atol=1e-9)


def test_what_a_track_was_before_it_lost_its_vehicle_belongs_to_the_one_that_follows_it():
    strays = straight(range(50))
    strays[30:, 0] += 0.3 * np.arange(20)
    dynamics, old = track_along(1, range(50), strays)
    _, young = track_along(2, range(28, 60), straight(range(28, 60)))
    _, beside = track_along(3, range(28, 60), straight(range(28, 60), x=3.5))
    _, ahead = track_along(4, range(28, 60), straight(range(28, 60)) + [0.0, 6.0, 0.0])
    _, elder = track_along(5, range(60), straight(range(60)))
    _, later = track_along(6, range(50, 60), straight(range(50, 60)))
    assert goes_on(old, young, dynamics)
    assert not any(goes_on(old, other, dynamics) for other in (beside, ahead, elder, later))


def test_a_track_that_was_hardly_seen_is_passed_on_to_nobody():
    dynamics, old = track_along(1, range(50), straight(range(50)))
    _, young = track_along(2, range(28, 60), straight(range(28, 60)))
    for sample in old.samples:
        sample.border = 0.5
    assert not goes_on(old, young, dynamics)


def test_a_track_beside_another_is_another_vehicle():
    dynamics, old = track_along(1, range(50), straight(range(50)))
    _, young = track_along(2, range(28, 60), straight(range(28, 60), x=3.5))
    assert part_before(old, dynamics, young.samples, straight(range(28, 60), x=3.5), CAR) is None


def test_what_comes_the_other_way_where_a_track_ends_is_another_vehicle():
    dynamics, old = track_along(1, range(50), straight(range(50)))
    back = np.array([[0.0, 20 + 0.2 * (99 - frame), -np.pi / 2] for frame in range(50, 90)])
    _, young = track_along(2, range(50, 90), back)
    assert part_before(old, dynamics, young.samples, back, CAR) is None


def test_nothing_drives_backwards_at_speed():
    truth = straight(range(60))
    truth[30:, 1] = truth[30, 1] - 0.6 * np.arange(30)  # 15 m/s, the other way
    dynamics, old = track_along(1, range(30), truth[:30])
    camera = road_camera()
    tracker = GroundTracker(camera, TrackerSettings(target=TargetSettings(classes=VEHICLES)))
    tracker.tracks = [old]
    for frame in range(30, 60):
        tracker.predict(frame / 25)
        tracker.update(frame, evidence_of(camera, labels_of(camera, [(truth[frame], CAR)])))
    mine = [track for track in tracker.tracks if track.id == 1]
    assert all(dynamics.planar(track.steps[-1].posterior.mean)[0][3] > -6.5 for track in mine)
