"""The box model against rendered boxes: projection, fit, covariance, partial views."""

import numpy as np
import pytest
from masks import CAR, road_camera

from visfuse_cli.maths.cameras import elevation, ground_scale, project
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.wireframe import DIRECTIONS, FAN, Outlines

pytestmark = pytest.mark.geometry


def passing_cars(n=40):
    return np.column_stack([np.linspace(0, 3, n), np.linspace(12, 45, n), np.full(n, np.pi / 2 - 0.1)])


def outlines_of(camera, pose, size, noise=0.0, seed=0):
    pixels, _ = project(camera, wireframe.corners(pose, np.tile(size, (len(pose), 1))))
    support = np.max(pixels @ FAN.T, axis=1)
    support = support + np.random.default_rng(seed).normal(0, noise, support.shape)
    return tangent_rows(support, np.ones(support.shape, dtype=bool))


def tangent_rows(support, valid):
    n = len(support)
    nowhere = np.zeros((n, DIRECTIONS, 2), dtype=int)
    width = 2 * support.mean(axis=1)
    none, every = 0.0 * support, np.ones(n, dtype=bool)
    return Outlines(np.tile(FAN, (n, 1, 1)), support, nowhere, none, valid, every, width, np.nan * support, none)


def fit(camera, outlines, start, size, size_sigma, sigma_px=1.5):
    n = len(start)
    return wireframe.fit(
        camera,
        outlines,
        start,
        np.tile([5.0, 5.0, 0.25], (n, 1)),
        np.tile(size, (n, 1)),
        np.full((n, 3), size_sigma),
        np.full(n, sigma_px),
    )


def test_camera_behind_an_exact_homography_is_recovered():
    camera = road_camera()
    np.testing.assert_allclose(camera.centre, [2, -3, 7.5], atol=0.05)
    assert camera.focal == pytest.approx(1100, rel=0.01)


def test_tracked_point_at_a_height_moves_towards_the_cameras_foot():
    camera = road_camera()
    top = np.array([[4.0, 25.0, 2.5]])
    pixel, _ = project(camera, top)
    H = camera.ground.ground_from_image
    homogeneous = H @ np.append(pixel[0], 1)
    seen_at = homogeneous[:2] / homogeneous[2]
    np.testing.assert_allclose(elevation(camera, seen_at[None], 2.5)[0], [4, 25], atol=0.05)


def test_ground_scale_is_infinite_above_the_horizon():
    camera = road_camera()
    near, far, sky = ground_scale(camera, np.array([[640.0, 700], [640, 200], [640, 5]]))
    assert near < far
    assert not np.isfinite(sky)


def test_exact_outlines_give_exact_boxes():
    camera, pose = road_camera(), passing_cars()
    start = pose + np.random.default_rng(1).normal(0, 1, pose.shape) * [0.8, 0.8, 0.05]
    found = fit(camera, outlines_of(camera, pose, CAR), start, CAR + [0.3, 0.1, 0.1], 2.0)
    np.testing.assert_allclose(found.pose[:, :2], pose[:, :2], atol=0.03)
    np.testing.assert_allclose(found.size, np.tile(CAR, (len(pose), 1)), atol=0.06)
    assert found.ok.all()


def test_noise_of_two_thirds_of_a_pixel_leaves_centimetres():
    camera, pose = road_camera(), passing_cars()
    found = fit(camera, outlines_of(camera, pose, CAR, noise=0.7), pose + [0.5, 0.5, 0.05], CAR, 0.01)
    error = found.pose - pose
    assert np.abs(error[:, 0]).mean() < 0.02
    assert np.abs(error[:, 1]).mean() < 0.05
    assert np.abs(error[:, 2]).mean() < np.radians(1)


def test_stated_covariance_covers_the_error():
    camera, pose = road_camera(), passing_cars()
    squared = []
    for seed in range(20):
        found = fit(camera, outlines_of(camera, pose, CAR, 1.5, seed), pose + [0.3, 0.3, 0.02], CAR, 0.01)
        error = (found.pose - pose)[:, :2]
        squared += list(np.einsum("ni,ni->n", error, np.linalg.solve(found.cov[:, :2, :2], error[..., None])[..., 0]))
    assert 1.0 < np.mean(squared) < 3.0  # two dimensions


def test_box_cut_off_at_the_bottom_is_placed_by_its_size():
    camera, pose = road_camera(), passing_cars(10)
    outlines = outlines_of(camera, pose, CAR, noise=0.5)
    downward = FAN[:, 1] > 0.2
    cut = tangent_rows(outlines.support, np.tile(~downward, (len(pose), 1)))
    found = fit(camera, cut, pose + [0.3, 0.5, 0.02], CAR, 0.02)
    assert np.abs(found.pose - pose)[:, 1].max() < 1.0
    assert (found.cov[:, 1, 1] > fit(camera, outlines, pose, CAR, 0.02).cov[:, 1, 1]).all()


def test_outline_counts_only_what_the_picture_holds():
    hull = np.array([[0.0, 100], [50, 60], [90, 150], [40, 200]])
    found = wireframe.tangents(hull, np.array([True, False, False, False]))
    assert found.support.shape == (DIRECTIONS,)
    assert found.support[0] == pytest.approx(90)
    assert not found.valid[DIRECTIONS // 2]  # leftmost point lies on the frame's edge
    assert found.valid[0]
    assert wireframe.tangents(hull, np.zeros(4, dtype=bool), upright=True).valid.sum() == 4
    assert wireframe.tangents(hull, np.zeros(4, dtype=bool), border_px=2.0).support[0] == pytest.approx(92)


def test_only_edges_between_a_seen_and_an_unseen_face_border_the_silhouette():
    camera, pose = road_camera(), passing_cars(10)
    size = np.tile(CAR, (len(pose), 1))
    border = wireframe.silhouette_edges(camera, pose, size)
    pixels, _ = project(camera, wireframe.corners(pose, size))
    for k in range(len(pose)):
        hull = wireframe.silhouette(camera, pose[k], size[k])
        around = np.linalg.norm(hull - np.roll(hull, 1, axis=0), axis=1).sum()
        ends = pixels[k, wireframe.EDGES[border[k]]]
        assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum() == pytest.approx(around, rel=0.01)
