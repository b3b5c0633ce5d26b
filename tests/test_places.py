"""Places on the ground: polygons, the region of interest, the trusted zone, a plane above the surveyed one."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from masks import CAR, drive, evidence_of, labels_of, road_camera

from visfuse_cli.maths.cameras import elevation, project, raised
from visfuse_cli.maths.homography import apply
from visfuse_cli.maths.polygons import area, contains, distance, surrounding
from visfuse_cli.tracking.conclude import CLEARANCE, SILL_DOUBT_M, conclude
from visfuse_cli.tracking.ground import GroundTracker
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.tracking.verdict import (
    LEAST_DOUBT,
    LIKE_A_PART,
    MOST_DOUBT,
    ODD,
    USUAL_MISFIT_PX,
    SpeedSettings,
    evidence,
    judge,
)
from visfuse_cli.tracking.zones import Region, stretch, trusted

CAMERA = road_camera()
ELL = np.array([[0.0, 0], [4, 0], [4, 1], [1, 1], [1, 3], [0, 3]])


def test_a_concave_polygon():
    points = np.array([[0.5, 0.5], [3.5, 0.5], [0.5, 2.5], [2, 2], [5, 0.5], [-1, 1]])
    assert contains(ELL, points).tolist() == [True, True, True, False, False, False]
    assert contains(ELL[::-1], points).tolist() == contains(ELL, points).tolist()
    np.testing.assert_allclose(distance(ELL, points)[[3, 4, 5]], [1, 1, 1])
    assert area(ELL) == pytest.approx(6)


@pytest.mark.parametrize("corners", [((0, 0), (1, 1)), ((0, 0), (1, 1), (2, 2))])
def test_what_surrounds_nothing_is_no_polygon(corners):
    with pytest.raises(ValueError, match="the yard"):
        surrounding(corners, "the yard")


@pytest.mark.parametrize("height", [-1.0, 0.0, 2.5])
def test_a_raised_plane_sees_its_points_where_they_are(height):
    ground = np.array([[4.0, 25.0], [-3, 40], [0, 15]])
    camera = raised(CAMERA, height)
    pixels, _ = project(CAMERA, np.column_stack([ground, np.full(3, height)]))
    np.testing.assert_allclose(apply(camera.ground.ground_from_image, pixels), ground, atol=0.05)
    np.testing.assert_allclose(project(camera, np.column_stack([ground, np.zeros(3)]))[0], pixels, atol=1e-6)
    seen_at = apply(CAMERA.ground.ground_from_image, pixels)
    mapped = apply(camera.ground.ground_from_image, pixels)
    np.testing.assert_allclose(mapped, elevation(CAMERA, seen_at, height), atol=1e-9)


def test_a_raised_plane_keeps_the_doubt_of_its_points():
    rng = np.random.default_rng(4)
    half = rng.normal(0, 1e-7, (9, 9))
    ground = replace(CAMERA.ground, cov=half @ half.T)
    doubted = replace(CAMERA, ground=ground)
    plain, high = (raised(doubted, h).ground.cov for h in (0.0, 3.5))
    share = 1 - 3.5 / CAMERA.centre[2]
    np.testing.assert_allclose(plain, ground.cov)
    np.testing.assert_allclose(high[6:, 6:], ground.cov[6:, 6:])
    shift = np.array(
        [[share, 0, (1 - share) * CAMERA.centre[0]], [0, share, (1 - share) * CAMERA.centre[1]], [0, 0, 1]]
    )
    entries = half.reshape(3, 3, 9).transpose(2, 0, 1) * 1.0
    sampled = sum(np.outer((shift @ e).ravel(), (shift @ e).ravel()) for e in entries)
    np.testing.assert_allclose(high, sampled)


def test_no_plane_lies_above_the_camera():
    with pytest.raises(ValueError, match="not above"):
        raised(CAMERA, CAMERA.centre[2] + 1)


def follow(truth, settings):
    tracker = GroundTracker(CAMERA, settings)
    tracks = []
    for k, pose in enumerate(truth):
        tracker.predict(k / 25)
        tracks += tracker.update(k, evidence_of(CAMERA, labels_of(CAMERA, [(pose, CAR)])))[0]
    return tracker, tracks + tracker.finish()[0]


@pytest.fixture(scope="module")
def passing():
    truth = drive((-1, 14), (0.4, 9), np.arange(80) / 25)
    square = ((-20, 20), (20, 20), (20, 32), (-20, 32))
    settings = TrackerSettings(region=square)
    tracker, tracks = follow(truth, settings)
    return square, settings, tracker, tracks


def test_nothing_outside_of_the_region_is_tracked(passing):
    square, settings, tracker, tracks = passing
    (track,) = tracks
    assert track.ended_by == "left the region"
    (whole,) = conclude([track], CAMERA, settings, tracker.dynamics)
    path = Region(np.array(square)).part(whole)
    assert path is not None
    assert contains(np.array(square), path.planar.mean[:, :2]).all()
    assert np.ptp(path.planar.mean[:, 1]) > 10
    assert len(path.t) == len(path.frame) == len(path.planar.cov) == len(path.ahead)
    elsewhere = Region(np.array([[50.0, 50], [60, 50], [60, 60]]))
    assert elsewhere.part(path) is None


def test_the_regions_picture_shows_what_stands_in_it_and_little_more():
    region = Region(np.array([[-2.0, 20], [2, 20], [2, 30], [-2, 30]]))
    mask = region.picture(CAMERA)
    assert mask.shape == CAMERA.image_size[::-1]
    for place, height, shown in (((0, 25), 0, True), ((0, 25), 3.5, True), ((15, 25), 0, False), ((0, 110), 0, False)):
        (u, v), _ = project(CAMERA, np.array([*place, height], dtype=float))
        assert (mask[round(v), round(u)] > 0) == shown


def test_the_trusted_zone_ends_where_the_calibration_does():
    assert trusted(CAMERA, np.array([[0.0, 25], [0, 30]]), 1.0, 0.1).all()
    bad = replace(CAMERA.ground, cov=np.diag([0, 0, 0, 0, 0, 0, 1e-7, 1e-7, 0.0]))
    zone = trusted(replace(CAMERA, ground=bad), np.array([[0.0, 12], [0, 70]]), 1.0, 0.1)
    assert zone.tolist() == [True, False]


def test_a_track_outside_the_trusted_zone_is_rejected_with_that_reason(passing):
    _, settings, tracker, (track,) = passing
    (path,) = conclude([track], CAMERA, settings, tracker.dynamics)
    verdicts = [
        judge(path, CAMERA.ground.cov, 1.0, SpeedSettings(), np.full(len(path.t), zone)).reason
        for zone in (True, False)
    ]
    assert verdicts == ["", "outside the trusted zone"]


def test_noise_speaks_against_a_track_and_a_vague_calibration_does_not(passing):
    _, settings, tracker, (track,) = passing
    (path,) = conclude([track], CAMERA, settings, tracker.dynamics)

    def judged(seen, entry_cov=CAMERA.ground.cov, least=SpeedSettings().min_evidence):
        return judge(seen, entry_cov, 1.0, SpeedSettings(min_evidence=least), np.ones(len(seen.t), dtype=bool))

    H = CAMERA.ground.ground_from_image
    lengths = np.append(H[:2].ravel(), [0.0, 0.0, 0.0])  # what is all of it wrong when the surveyor's tape is
    clear, vague = judged(path), judged(path, 0.05**2 * np.outer(lengths, lengths))
    noisy = replace(path, pose_cov=path.pose_cov + np.diag([1.0, 1.0, 0.0, 0.0]))
    assert clear.reason == vague.reason == ""
    assert vague.sigma > 0.04 * 8.9
    well, badly = evidence(path, clear), evidence(noisy, judged(noisy))
    assert evidence(path, vague) == pytest.approx(well, abs=0.05)
    assert badly < well - 0.5
    between = (well + badly) / 2
    assert judged(path, least=between).reason == ""
    assert judged(noisy, least=between).reason.startswith("too little seen")
    wild = replace(path, pose_cov=path.pose_cov + np.diag([16.0, 16.0, 0.0, 0.0]), misfit_px=USUAL_MISFIT_PX)
    assert judged(wild).reason.startswith("too uncertain")


def test_the_interval_knows_how_well_the_box_fits_and_what_speaks_for_a_track_does_not(passing):
    _, settings, tracker, (track,) = passing
    (path,) = conclude([track], CAMERA, settings, tracker.dynamics)

    def judged(**changed):
        seen = replace(path, **changed)
        verdict = judge(seen, 0 * CAMERA.ground.cov, 1.0, SpeedSettings(), np.ones(len(path.t), dtype=bool))
        return verdict, evidence(seen, verdict)

    def own(**changed):
        verdict = judged(**changed)[0]
        return np.sqrt(verdict.sigma**2 - (path.clearance * verdict.speed) ** 2)

    usual, well = judged(misfit_px=USUAL_MISFIT_PX, apart=1.0)
    off, badly = judged(misfit_px=2 * USUAL_MISFIT_PX, apart=1.0)
    assert own(misfit_px=USUAL_MISFIT_PX, apart=1.0) == pytest.approx(usual.noise)
    assert own(misfit_px=2 * USUAL_MISFIT_PX, apart=1.0) == pytest.approx(2 * usual.noise)
    assert (off.noise, badly) == (usual.noise, well)
    assert own(misfit_px=USUAL_MISFIT_PX, apart=0.95) > 1.3 * usual.noise
    assert own(misfit_px=0.01, apart=1.0) == pytest.approx(LEAST_DOUBT * usual.noise)
    assert own(misfit_px=99.0, apart=0.5) == pytest.approx(MOST_DOUBT * usual.noise)
    assert own(misfit_px=np.nan) == pytest.approx(usual.noise)  # no box was fitted again


def test_where_it_stands_in_shadow_it_is_less_known_where_a_vehicle_meets_the_ground(passing):
    _, settings, tracker, (whole,) = passing
    track, found = deepcopy(whole), []
    for shaded in (0.0, 1.0):
        for sample in track.samples:
            sample.shaded = shaded
        (path,) = conclude([track], CAMERA, settings, tracker.dynamics)
        found.append((path.clearance, judge(path, 0 * CAMERA.ground.cov, 1.0, SpeedSettings(), path.measured)))
    (sure, usual), (doubt, doubtful) = found
    assert sure == CLEARANCE
    assert doubt == pytest.approx(np.hypot(CLEARANCE, SILL_DOUBT_M / CAMERA.centre[2]))
    assert doubtful.speed == usual.speed
    more = (doubt**2 - sure**2) * usual.speed**2
    assert doubtful.sigma**2 - usual.sigma**2 == pytest.approx(more)


def test_what_is_slim_must_be_seen_better_and_of_all_else_an_odd_size(passing):
    _, settings, tracker, (track,) = passing
    (path,) = conclude([track], CAMERA, settings, tracker.dynamics)
    verdict = judge(path, CAMERA.ground.cov, 1.0, SpeedSettings(), np.ones(len(path.t), dtype=bool))
    bike, person = (replace(path, size=np.array(size), size_z=1.0) for size in ([2.0, 0.7, 1.5], [0.5, 0.5, 1.7]))
    usual = replace(path, size_z=0.0)
    assert evidence(bike, verdict) == pytest.approx(evidence(usual, verdict) - LIKE_A_PART)
    assert evidence(person, verdict) == pytest.approx(evidence(usual, verdict) - ODD)
    assert evidence(replace(bike, size_z=3.0), verdict) == evidence(bike, verdict)


@pytest.mark.parametrize("frames", [slice(10, 40), slice(10, 11)], ids=["a stretch", "one frame"])
def test_what_was_hidden_all_the_way_through_a_region_is_rejected_with_that_reason(passing, frames):
    _, settings, tracker, (track,) = passing
    (path,) = conclude([track], CAMERA, settings, tracker.dynamics)
    part = stretch(replace(path, measured=np.zeros(len(path.t), dtype=bool)), frames)
    verdict = judge(part, CAMERA.ground.cov, 1.0, SpeedSettings(min_measured=0), np.ones(len(part.t), dtype=bool))
    assert verdict.reason == "never seen: all of it is predicted"
    assert np.isfinite([verdict.speed, verdict.sigma, verdict.distance, verdict.course]).all()


def test_positions_ahead_are_where_the_car_is_then():
    truth = drive((-1, 14), (0.4, 9), np.arange(80) / 25)
    for settings in (TrackerSettings(latency=0.4), TrackerSettings(latency=0.4, smooth=False)):
        tracker, (track,) = follow(truth, settings)
        (path,) = conclude([track], CAMERA, settings, tracker.dynamics)
        late = path.frame + 10
        known = (late < len(truth)) & (np.arange(len(late)) > 12)
        error = np.linalg.norm(path.ahead[known] - truth[late[known], :2], axis=1)
        assert np.median(error) < 0.4
