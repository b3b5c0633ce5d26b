"""The tracker on exact label pictures: births, look-back, hiding, joining, detections, ends."""

from types import SimpleNamespace

import numpy as np
import pytest
from masks import CAR, SIZE, TRUCK, drive, evidence_of, labels_of, road_camera

from visfuse_cli.maths.angles import wrap
from visfuse_cli.tracking import hypotheses
from visfuse_cli.tracking.conclude import conclude
from visfuse_cli.tracking.dynamics import WHEELBASE_SHARE, for_target
from visfuse_cli.tracking.evidence import BoxEvidence
from visfuse_cli.tracking.ground import GroundTracker
from visfuse_cli.tracking.settings import PERSON, FilterSettings, LifeSettings, TargetSettings, TrackerSettings
from visfuse_cli.tracking.verdict import SpeedSettings, evidence, judge
from visfuse_cli.vision import regions, wireframe

CAMERA = road_camera()
NOBODY = np.zeros((0, 3)), np.zeros((0, 3))
FPS = 25.0


def follow(frames, settings=None, evidence=evidence_of):
    """Everything that ended, of frames (lists of boxes) seen one by one."""
    tracker = GroundTracker(CAMERA, settings or TrackerSettings())
    tracks, abandoned = [], []
    for k, boxes in enumerate(frames):
        tracker.predict(k / FPS)
        ended = tracker.update(k, evidence(CAMERA, labels_of(CAMERA, boxes)))
        tracks += ended[0]
        abandoned += ended[1]
    ended = tracker.finish()
    return tracker, tracks + ended[0], abandoned + ended[1]


def poses(track, tracker):
    x = np.stack([step.posterior.mean for step in track.steps])
    return np.column_stack([x[:, :2], tracker.dynamics.heading(x)])


def error(track, tracker, truth):
    """Distance (n,) m from the truth's poses (frames, 3), and heading error (n,) rad."""
    at = np.array([sample.frame for sample in track.samples])
    mine = poses(track, tracker)
    return np.linalg.norm(mine[:, :2] - truth[at, :2], axis=1), np.abs(wrap(mine[:, 2] - truth[at, 2]))


def region_of(boxes):
    (region,) = evidence_of(CAMERA, labels_of(CAMERA, boxes)).leftovers(*NOBODY)
    return region


@pytest.mark.parametrize(("name", "size"), [("car", CAR), ("truck", TRUCK), ("two-wheeler", np.array([2.0, 0.8, 1.6]))])
def test_a_region_is_taken_for_the_class_that_it_is(name, size):
    pose = np.array([2.0, 24.0, 1.4])
    evidence = evidence_of(CAMERA, labels_of(CAMERA, [(pose, size)]))
    guess = hypotheses.best_guess(CAMERA, TrackerSettings(), evidence, region_of([(pose, size)]), 1.4, NOBODY)
    assert guess is not None
    assert guess.prior.name == name
    np.testing.assert_allclose(guess.pose[:2], pose[:2], atol=0.5)
    np.testing.assert_allclose(guess.size, size, rtol=0.2)
    tried = np.stack([guess.pose, guess.pose + [1.0, 3.0, 0.0]])
    gains = hypotheses.gains(CAMERA, [evidence] * 2, tried, np.tile(guess.size, (2, 1)), [NOBODY] * 2)
    assert gains[1] < guess.gain <= gains[0]


def test_a_van_close_to_the_camera_is_found_beside_its_shadow():
    pose, size = np.array([2.0, 11.0, 0.9]), np.array([5.4, 2.0, 2.3])
    evidence = evidence_of(CAMERA, labels_of(CAMERA, [(pose, size)], [(pose - [0.3, 1.5, 0.0], size * [1, 1, 0.02])]))
    (region,) = evidence.leftovers(*NOBODY)
    guess = hypotheses.best_guess(CAMERA, TrackerSettings(), evidence, region, 0.9, NOBODY)
    assert guess is not None
    np.testing.assert_allclose(guess.pose[:2], pose[:2], atol=0.1)
    np.testing.assert_allclose(guess.size, size, atol=0.1)


def test_what_was_given_the_course_of_another_is_turned_round():
    truth = drive([2.0, 20.0], [1.0, 10.0], np.arange(20) / FPS)
    tracker = GroundTracker(CAMERA, TrackerSettings(life=LifeSettings(birth_scale=1e-3)))
    for k, pose in enumerate(truth):
        tracker.predict(k / FPS)
        tracker.update(k, evidence_of(CAMERA, labels_of(CAMERA, [(pose, CAR)])))
    turned, seen = float(truth[0, 2] + np.pi), tracker._recent[-1][2]
    guess = hypotheses.best_guess(CAMERA, tracker.settings, seen, region_of([(truth[-1], CAR)]), turned, NOBODY)
    assert guess is not None
    track = tracker._nursery.grown(guess, np.array([-1.0, -10.0]), 1, tracker._recent, lambda _: NOBODY, [])
    assert track is not None
    off, angle = error(track, tracker, truth)
    assert len(track.samples) == len(truth)
    assert off.max() < 0.5
    assert angle.max() < 0.1


def test_a_shadow_alone_is_taken_for_nothing():
    pose = np.array([2.0, 24.0, 1.4])
    evidence = evidence_of(CAMERA, labels_of(CAMERA, [], [(pose, CAR)]))
    region = region_of([(pose, CAR)])
    assert hypotheses.best_guess(CAMERA, TrackerSettings(), evidence, region, 1.4, NOBODY) is None


def test_a_car_is_one_track_from_where_it_was_first_seen():
    t = np.arange(50) / FPS
    truth = drive([1.0, 16.0], [-1.5, 12.0], t)
    tracker, tracks, _ = follow([[(pose, CAR)] for pose in truth])
    (track,) = tracks
    assert (track.samples[0].frame, track.samples[-1].frame) == (0, 49)
    assert track.prior_class.name == "car"
    distance, turned = error(track, tracker, truth)
    assert np.median(distance) < 0.25
    assert np.median(turned) < 0.05
    (path,) = conclude([track], CAMERA, tracker.settings, tracker.dynamics)
    speed = np.linalg.norm(path.planar.mean[10:-10, 2:], axis=1)
    np.testing.assert_allclose(speed, np.hypot(1.5, 12.0), rtol=0.03)


def test_a_car_behind_a_truck_keeps_its_number():
    t = np.arange(75) / FPS
    behind, front = drive([-4.0, 27.0], [4.0, 4.0], t), drive([15.0, 18.0], [-9.0, 0.3], t)
    tracker, tracks, _ = follow([[(a, CAR), (b, TRUCK)] for a, b in zip(behind, front, strict=True)])
    cars = [track for track in tracks if np.median(error(track, tracker, behind)[0]) < 1.0 and len(track.samples) > 10]
    (car,) = cars
    assert car.samples[-1].frame - car.samples[0].frame > 60
    assert error(car, tracker, behind)[0][-1] < 1.5


def test_two_that_touch_are_two():
    t = np.arange(40) / FPS
    left, right = drive([0.0, 18.0], [0.0, 11.0], t), drive([2.6, 20.0], [0.0, 10.0], t)
    tracker, tracks, _ = follow([[(a, CAR), (b, CAR)] for a, b in zip(left, right, strict=True)])
    assert len(tracks) == 2
    for truth in (left, right):
        assert min(np.median(error(track, tracker, truth)[0]) for track in tracks) < 0.5


def test_a_car_that_stops_stays_where_it_is():
    t = np.arange(130) / FPS
    way = np.where(t < 2, 10 * t - 2.5 * t**2, 10.0)  # brakes at 5 m/s^2
    truth = drive([1.0, 16.0], [0.0, 1.0], way)
    tracker, tracks, _ = follow([[(pose, CAR)] for pose in truth])
    (track,) = tracks
    assert track.samples[-1].frame == len(truth) - 1
    assert error(track, tracker, truth)[0][-50:].max() < 0.5
    assert abs(track.steps[-1].posterior.mean[2]) < 0.3


def test_a_car_that_stands_hidden_for_seconds_is_the_same_when_it_drives_on():
    t = np.arange(225) / FPS
    way = np.where(t < 2, 10 * t - 2.5 * t**2, 10.0) + np.clip(t - 6.6, 0, None) ** 2  # brakes, waits, goes at 2 m/s^2
    truth = drive([1.0, 14.0], [0.0, 1.0], way)
    hidden = (t > 2.6) & (t < 6.6)
    tracker, tracks, _ = follow([[] if gone else [(pose, CAR)] for pose, gone in zip(truth, hidden, strict=True)])
    (track,) = tracks
    assert track.samples[0].t < 0.5
    assert track.samples[-1].frame == len(truth) - 1
    assert error(track, tracker, truth)[0][-20:].max() < 0.5


def test_half_an_outline_is_believed_when_it_was_seen_for_long_and_stands_apart():
    def seen(support, apart, paint, seconds):
        t = np.arange(0, seconds, 1 / FPS)
        known = np.ones(len(t), bool)
        path = SimpleNamespace(support=support, apart=apart, paint=paint, t=t, measured=known, size=CAR, size_z=1.0)
        return evidence(path, SimpleNamespace(speed=10.0, noise=0.1))

    least = SpeedSettings().min_evidence
    assert seen(0.9, 1.0, 0.9, 1.0) > least
    assert seen(0.5, 0.9, 0.6, 1.5) < least
    assert seen(0.5, 0.9, 0.6, 12.0) > least
    assert seen(0.4, 0.85, 0.05, 12.0) < least
    assert seen(0.6, 0.5, 0.9, 4.0) < least


def test_who_starts_fast_has_not_jumped():
    t = np.arange(75) / FPS
    way = t + 5.0 * t**2 / 2
    tracker, tracks, _ = follow([[(pose, CAR)] for pose in drive([1.0, 12.0], [0.05, 1.0], way)])
    (path,) = conclude(tracks, CAMERA, TrackerSettings(), tracker.dynamics)
    verdict = judge(path, CAMERA.ground.cov, 1.0, SpeedSettings(), np.ones(len(path.t), dtype=bool))
    assert verdict.reason == ""
    assert verdict.speed == pytest.approx(1.0 + 5.0 * (path.t[verdict.first] + path.t[verdict.last]) / 2, abs=0.1)


def test_what_never_moves_is_given_up_with_its_place():
    pose = np.array([2.0, 24.0, 1.4])
    _, tracks, abandoned = follow([[(pose, CAR)]] * 170)
    assert tracks == []
    given_up = abandoned[0]
    assert given_up.reason == "did not move"
    assert np.linalg.norm(given_up.position - pose[:2]) < 3


def test_what_creeps_is_found():
    t = np.arange(80) / FPS
    truth = drive([1.0, 16.0], [0.1, 1.2], t)
    tracker, tracks, _ = follow([[(pose, CAR)] for pose in truth])
    (track,) = tracks
    assert np.median(error(track, tracker, truth)[0]) < 0.3


def test_an_empty_road_has_no_tracks():
    assert follow([[]] * 5)[1:] == ([], [])


def test_people_walk_by_the_same_machinery():
    t = np.arange(60) / FPS
    size = np.array([0.5, 0.5, 1.72])
    truth = drive([0.5, 14.0], [1.4, 0.2], t)
    target = TargetSettings(motion="constant-velocity", classes=PERSON)
    settings = TrackerSettings(target=target, life=LifeSettings(confirm_m=0.6))
    tracker, tracks, _ = follow([[(pose, size)] for pose in truth], settings)
    (track,) = tracks
    assert np.median(error(track, tracker, truth)[0]) < 0.2


def test_detections_from_outside_are_tracked_alike():
    t = np.arange(50) / FPS
    truth = drive([1.0, 16.0], [-1.5, 12.0], t)

    def boxes(camera, labels):
        v, u = np.nonzero(labels)
        box = np.array([u.min() - 0.5, v.min() - 0.5, np.ptp(u) + 1, np.ptp(v) + 1])
        return BoxEvidence([regions.from_box(box, 1.0, SIZE)], camera)

    tracker, tracks, _ = follow([[(pose, CAR)] for pose in truth], evidence=boxes)
    (track,) = tracks
    assert len(track.samples) > 40
    assert np.median(error(track, tracker, truth)[0]) < 0.7


def test_silhouettes_of_the_live_tracks_are_their_outlines():
    t = np.arange(30) / FPS
    truth = drive([1.0, 16.0], [0.0, 10.0], t)
    tracker = GroundTracker(CAMERA, TrackerSettings())
    for k, pose in enumerate(truth):
        tracker.predict(k / FPS)
        tracker.update(k, evidence_of(CAMERA, labels_of(CAMERA, [(pose, CAR)])))
    ((pose,), (size,)) = tracker.boxes()
    outline = wireframe.silhouette(CAMERA, pose, size)
    true = wireframe.silhouette(CAMERA, truth[-1], CAR)
    np.testing.assert_allclose(outline.min(axis=0), true.min(axis=0), atol=8)
    np.testing.assert_allclose(outline.max(axis=0), true.max(axis=0), atol=8)


@pytest.mark.parametrize("kind", ["fading", "cuf"])
def test_steering_wanders_freely_at_walking_pace_and_by_the_lateral_jerk_at_speed(kind):
    settings, length, dt = FilterSettings(kind=kind, straighten=0), 4.5, 0.04
    dynamics = for_target(TargetSettings(), settings)
    lateral = settings.sigma_corner * WHEELBASE_SHARE * length
    for speed, expected in ((1.0, settings.sigma_steer), (40.0, lateral / 40.0**2)):
        x = dynamics.begin(np.zeros(3), np.array([speed, 0.0])).mean[None]
        Q = dynamics.advance(x, np.zeros((1, x.shape[1], x.shape[1])), np.array([dt]), np.array([length]))[2]
        assert np.sqrt(Q[0, 4, 4] / dt) == pytest.approx(expected, rel=0.02)
