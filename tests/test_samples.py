"""The scene generator tells the truth: silhouettes, velocities, times; and the same seed gives the same bytes."""

from collections import Counter
from dataclasses import replace
from fractions import Fraction
from itertools import combinations

import av
import cv2
import numpy as np
import pytest

from samples.bodies import Patch
from samples.files import write_clip, write_scene
from samples.render import draw, far_to_near, frames, shakes
from samples.road import KINDS, calibration_points, dense_low, free_flow
from samples.scene import FACES, Light, share_inside
from samples.ship import SAMPLE, shipped_scene
from samples.visibility import truth_rows

SMALL = (640, 360)
WHITE = Light(np.array([0.0, 0.0, 1.0]))


def white_box() -> list[Patch]:
    whole = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    return [Patch(face, whole, (255 * 4, 255 * 4, 255 * 4), base=True) for face in FACES]


def chord(hull: np.ndarray, row: float) -> tuple[float, float]:
    """Where the line v = row enters and leaves a convex polygon."""
    cuts = []
    for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        if (a[1] - row) * (b[1] - row) < 0:
            cuts.append(a[0] + (row - a[1]) / (b[1] - a[1]) * (b[0] - a[0]))
    return min(cuts), max(cuts)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_rendered_silhouette_is_the_projected_box(seed):
    scene = free_flow(seed, 8, SMALL)
    measured = 0
    for vehicle in scene.vehicles:
        for state in vehicle.trajectory(scene.times)[::12]:
            corners = vehicle.corners(state)
            if share_inside(scene.camera, corners) < 1:
                continue
            picture = np.zeros((SMALL[1], SMALL[0], 3), np.uint8)
            draw(picture, scene.camera, WHITE, corners, white_box())
            alpha = picture[..., 1] / 255
            hull = cv2.convexHull(scene.camera.project(corners).astype(np.float32)).reshape(-1, 2).astype(float)
            for row in range(int(hull[:, 1].min()) + 2, int(hull[:, 1].max()) - 1):
                left, right = chord(hull, row)
                if np.abs(hull[:, 1] - row).min() < 1 or right - left < 4:
                    continue
                full = np.flatnonzero(alpha[row] > 0.999)
                if not len(full):
                    continue
                middle = full[len(full) // 2]
                assert middle + 0.5 - alpha[row, : middle + 1].sum() == pytest.approx(left, abs=0.15)
                assert middle + 0.5 + alpha[row, middle + 1 :].sum() == pytest.approx(right, abs=0.15)
                measured += 1
    assert measured > 100


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_true_velocity_is_the_derivative_of_true_position(kind):
    scene = KINDS[kind](4, 12, SMALL)
    assert len(scene.vehicles) >= 4
    h = 1e-4
    for vehicle in scene.vehicles:
        before, now, after = (vehicle.trajectory(scene.times + shift) for shift in (-h, 0.0, h))
        slope = (after[:, :2] - before[:, :2]) / (2 * h)
        np.testing.assert_allclose(now[:, 3:], slope, atol=5e-3)
        assert np.hypot(now[:, 3], now[:, 4]).max() < 91 / 3.6


@pytest.mark.parametrize("kind", sorted(KINDS))
@pytest.mark.parametrize("seed", [0, 5])
def test_vehicles_never_overlap(kind, seed):
    scene = KINDS[kind](seed, 12, SMALL)
    for a, b in combinations(scene.vehicles, 2):
        for state_a, state_b in zip(*(v.trajectory(scene.times[::5]) for v in (a, b)), strict=True):
            outlines = [v.corners(s)[:4, :2].astype(np.float32) for v, s in ((a, state_a), (b, state_b))]
            shared, _ = cv2.intersectConvexConvex(*outlines)
            assert shared < 0.01, (a.id, b.id)


def test_a_junction_has_turning_reversing_and_standing_vehicles():
    scene = KINDS["junction"](4, 15, SMALL)
    turned, backed, stood = 0, 0, 0
    for vehicle in scene.vehicles:
        states = vehicle.trajectory(scene.times)
        along = states[:, 3] * np.cos(states[:, 2]) + states[:, 4] * np.sin(states[:, 2])
        turned += abs(states[-1, 2] - states[0, 2]) > 1.0
        backed += along.min() < -1
        stood += (np.abs(along) < 0.05).sum() > 10
    assert turned >= 2
    assert backed >= 1
    assert stood >= 2


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_calibration_points_are_the_projections_of_the_ground(kind):
    scene = KINDS[kind](6, 4)
    exact = np.array(calibration_points(scene, 12, 0.0))
    pixels = scene.camera.project(np.column_stack([exact[:, 2:], np.zeros(12)]))
    np.testing.assert_allclose(exact[:, :2], pixels, atol=1e-9)
    ahead = np.linalg.norm(exact[:, 2:] - scene.camera.centre[:2], axis=1)
    assert ahead.min() < 18
    assert ahead.max() > 47
    noisy = np.array(calibration_points(scene, 12, 0.4))
    assert 0.1 < np.std(noisy[:, :2] - pixels) < 0.8


def test_nearer_vehicles_are_drawn_last():
    scene = KINDS["dense"](5, 10, SMALL)
    boxes = [(v, v.corners(v.trajectory(scene.times[-1:])[0])) for v in scene.vehicles]
    order = [v.id for v, _ in far_to_near(scene.camera, boxes)]
    assert sorted(order) == sorted(v.id for v in scene.vehicles)
    eye = (scene.camera.centre[:2] - scene.placement.offset) @ scene.placement.rotation
    lanes: dict[float, list[tuple[float, int]]] = {}
    for vehicle, box in boxes:
        middle = (box[:4, :2].mean(axis=0) - scene.placement.offset) @ scene.placement.rotation
        if middle[1] > eye[1] + 10:
            lanes.setdefault(round(float(middle[0]), 3), []).append((float(middle[1]), vehicle.id))
    assert max(map(len, lanes.values())) > 2
    for lane in lanes.values():
        places = [order.index(number) for _, number in sorted(lane, reverse=True)]
        assert places == sorted(places)


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write_scene(replace(free_flow(9, 1, SMALL), shake=1.0), tmp_path / name)
    for path in sorted((tmp_path / "a").iterdir()):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_shake_has_the_rms_it_was_given():
    shifts = shakes(KINDS["dense"](1, 60, SMALL))
    np.testing.assert_allclose(shifts.std(axis=0), 2.0, rtol=0.2)


@pytest.mark.parametrize("fps", [Fraction(25), Fraction(30), Fraction(30000, 1001)])
def test_times_in_the_clip_are_exact(tmp_path, fps):
    scene = free_flow(2, 1, SMALL, fps)
    write_clip(tmp_path / "clip.mp4", frames(scene), SMALL, fps, 23)
    with av.open(str(tmp_path / "clip.mp4")) as container:
        stamps = [frame.pts * frame.time_base for frame in container.decode(video=0)]
    assert stamps == [index / fps for index in range(scene.n_frames)]


def test_truth_is_listed_while_half_of_the_box_is_in_the_picture():
    scene = free_flow(3, 6, SMALL)
    listed = {(frame, number) for frame, _, number, _ in truth_rows(scene)}
    for vehicle in scene.vehicles:
        for frame, state in enumerate(vehicle.trajectory(scene.times)):
            inside = share_inside(scene.camera, vehicle.corners(state)) >= 0.5
            assert inside == ((frame, vehicle.id) in listed)


def test_truth_leaves_out_what_others_hide():
    scene = dense_low(1, 8, SMALL)
    together = Counter(number for _, _, number, _ in truth_rows(scene))
    alone = {v.id: len(truth_rows(replace(scene, vehicles=(v,)))) for v in scene.vehicles}
    assert all(together[number] <= frames for number, frames in alone.items())
    assert min(together[number] / frames for number, frames in alone.items() if frames) < 0.5


def test_the_shipped_sample_is_the_scene_that_makes_it():
    scene = shipped_scene()
    assert 5 <= len(scene.vehicles) <= 7
    rows = [line.split(",") for line in (SAMPLE / "truth.csv").read_text(encoding="utf-8").splitlines()[1:]]
    expected = truth_rows(scene)
    assert len(rows) == len(expected)
    for row, (frame, t, number, state) in zip(rows, expected, strict=True):
        assert (int(row[0]), int(row[2])) == (frame, number)
        values = [float(row[i]) for i in (1, 3, 4, 6, 7)]
        np.testing.assert_allclose(values, [t, *state[:2], *state[3:]], atol=1e-4)
    assert (SAMPLE / "clip.mp4").stat().st_size <= 1.3e6
