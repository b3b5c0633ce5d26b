"""Planes that move, paths in space, and the particle filter's core: identities to machine precision."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from visfuse_cli.maths import gaussian, particles, paths, planes
from visfuse_cli.records import Gaussian, Lens, StereoRig

pytestmark = pytest.mark.geometry
K1 = np.array([[2200.0, 0, 500], [0, 2190, 380], [0, 0, 1]])
K2 = np.array([[2150.0, 0, 520], [0, 2160, 390], [0, 0, 1]])
RIG = StereoRig(
    Lens(K1, np.zeros(5)),
    Lens(K2, np.zeros(5)),
    Rotation.from_euler("xyz", [0.02, -0.03, 0.01]).as_matrix(),
    np.array([-0.5, 0.02, 0.03]),
    None,
)


def warp(H, pixels):
    mapped = np.column_stack([pixels, np.ones(len(pixels))]) @ H.T
    return mapped[:, :2] / mapped[:, 2:]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_homographies_take_pixels_before_a_motion_to_those_after_in_both_views_and_across(seed):
    rng = np.random.default_rng(seed)
    n = np.array([0.1, 0.05, -1.0]) + 0.2 * rng.normal(size=3)
    n /= np.linalg.norm(n)
    centre = np.array([rng.normal(), rng.normal(), 30.0])
    d = float(n @ centre)
    basis = np.linalg.svd(n[None])[2][1:]
    points = centre + rng.uniform(-1, 1, (6, 2)) @ basis
    R, t = Rotation.from_rotvec(0.05 * rng.normal(size=3)).as_matrix(), rng.normal(size=3) * [0.3, 0.1, 2]
    after = points @ R.T + t
    H = planes.induced(K1, K1, R, t, n, np.array(d))
    np.testing.assert_allclose(warp(H, planes.projected(K1, points)), planes.projected(K1, after), atol=1e-8)
    n2, d2 = planes.moved_plane(n, np.array(d), R, t)
    np.testing.assert_allclose(after @ n2, d2, atol=1e-9)
    Rr, tr = planes.right_motion(RIG, R, t)
    nr, dr = planes.right_plane(RIG, n, np.array(d))
    H = planes.induced(K2, K2, Rr, tr, nr, dr)
    before_right, after_right = (planes.projected(K2, planes.in_right(RIG, p)) for p in (points, after))
    np.testing.assert_allclose(warp(H, before_right), after_right, atol=1e-8)
    H = planes.across(RIG, n, np.array(d))
    np.testing.assert_allclose(warp(H, planes.projected(K1, points)), before_right, atol=1e-8)
    k = np.array([0.02, 0.0, -1.0]) / np.linalg.norm([0.02, 0.0, -1.0])
    H = planes.shifted(K1, k, np.array(2.0), n, np.array(d))
    np.testing.assert_allclose(warp(H, planes.projected(K1, points)), planes.projected(K1, points + 2 * k), atol=1e-8)
    left = planes.projected(K1, points)
    np.testing.assert_allclose(planes.triangulated(RIG, left, before_right), points, atol=1e-7)
    assert np.abs(planes.epipolar_offset(RIG, left, before_right)).max() < 1e-8


def images(points):
    return planes.projected(K1, points), planes.projected(K2, planes.in_right(RIG, points))


def test_a_straight_path_is_found_from_its_two_images():
    ends = np.array([[4.0, 1.4, 80.0], [3.0, 1.4, 20.0]])
    left, right = images(ends)
    shifted = right[0] + 0.9 * (right[1] - right[0])  # the ends need not correspond
    way = paths.straight(RIG, left, np.stack([right[0], shifted]))
    k = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    np.testing.assert_allclose(way.frame(np.array(5.0))[1][:, 0], k, atol=1e-7)
    assert np.linalg.norm(np.cross(way.frame(np.array(0.0))[0] - ends[0], k)) < 1e-5


def test_a_path_that_both_cameras_see_as_one_plane_is_refused():
    ends = np.array([[0.0, 1.4, 80.0], [0.0, 1.4, 20.0]])
    flat = StereoRig(RIG.left, RIG.left, np.eye(3), np.array([-0.5, 0, 0]), None)
    line = planes.projected(K1, np.array([[0, 0.0, 80], [3, 0, 20]]))  # through the baseline's direction
    right = planes.projected(K1, np.array([[0, 0.0, 80], [3, 0, 20]]) + flat.T)
    with pytest.raises(ValueError, match="one plane"):
        paths.straight(flat, line, right)
    assert ends.shape == (2, 3)


def test_a_curved_path_is_found_from_polylines_that_do_not_correspond():
    turn = np.linspace(0, 0.7, 9)
    truth = np.column_stack([50 * (1 - np.cos(turn)) - 3, np.full(9, 1.4), 60 - 50 * np.sin(turn)])
    left, _ = images(truth)
    fine = np.linspace(-0.02, 0.72, 14)
    _, right = images(np.column_stack([50 * (1 - np.cos(fine)) - 3, np.full(14, 1.4), 60 - 50 * np.sin(fine)]))
    way = paths.curved(RIG, left, right)
    places = way.frame(np.linspace(0, way.length, 50))[0]
    radius = np.hypot(places[:, 0] - 47, places[:, 2] - 60)
    assert np.abs(radius - 50).max() < 0.6
    assert 28 < way.length < 36  # the first four pixels of the image hold five metres, which are told badly
    fast = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert np.ptp(fast) / fast.mean() < 0.01  # arc length, not chord or parameter


def test_the_frame_of_a_way_is_orthonormal_and_goes_on_beyond_the_ends():
    way = paths.Way(np.array([[0, 0, 10.0], [1, 0, 12], [3, 0.1, 15], [6, 0.1, 16]]))
    s = np.linspace(-3, way.length + 3, 40)
    axes = way.frame(s)[1]
    np.testing.assert_allclose(axes.swapaxes(1, 2) @ axes, np.tile(np.eye(3), (40, 1, 1)), atol=1e-12)
    assert abs(way.nearest(way.frame(np.array(4.2))[0]) - 4.2) < 1e-3


def test_particles_match_the_kalman_filter_on_a_linear_toy():
    rng = np.random.default_rng(5)
    F, Q, H, R = np.array([[1, 0.2], [0, 1]]), np.diag([0.01, 0.04]), np.array([[1.0, 0]]), np.array([[0.09]])
    belief = Gaussian(np.zeros(2), np.diag([0.5, 1.0]))
    states = rng.multivariate_normal(belief.mean, belief.cov, size=20_000)
    weights = np.full(20_000, -np.log(20_000))
    for z in (0.3, 0.5, 0.9, 1.1):
        belief = gaussian.predict(belief, F, Q)
        belief, _ = gaussian.update(belief, np.array([z]) - H @ belief.mean, H, R)
        states = states @ F.T + rng.multivariate_normal(np.zeros(2), Q, size=len(states))
        weights = particles.normalised(weights - 0.5 * (z - states[:, 0]) ** 2 / R[0, 0])
        if particles.effective_number(weights) < 0.5 * len(states):
            states = states[particles.systematic(weights, rng)]
            weights = np.full(len(states), -np.log(len(states)))
    found = particles.moments(states, weights)
    np.testing.assert_allclose(found.mean, belief.mean, atol=0.02)
    np.testing.assert_allclose(found.cov, belief.cov, atol=0.03)


def test_systematic_draws_are_as_often_as_the_weights_say_and_regularising_keeps_the_moments():
    rng = np.random.default_rng(1)
    weights = particles.normalised(np.log(np.array([0.1, 0.2, 0.7])))
    drawn = np.bincount(particles.systematic(weights, rng, 1000), minlength=3)
    assert np.abs(drawn - [100, 200, 700]).max() <= 1
    states = rng.normal(size=(5000, 3)) @ np.diag([1, 2, 0.5])
    equal = np.full(5000, -np.log(5000))
    before, after = (
        particles.moments(states, equal),
        particles.moments(particles.regularised(states, equal, rng), equal),
    )
    np.testing.assert_allclose(after.cov, before.cov, atol=0.15)
    with pytest.raises(ValueError, match="no particle"):
        particles.normalised(np.full(3, -np.inf))
