"""Several cameras, one estimate: triangulation, the closed loop, and its rivals against the centralised bound."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visfuse_cli.fusing.estimate import Sights, fuse
from visfuse_cli.maths import fusion, fusion_rivals, gaussian, multiview, triangulation
from visfuse_cli.maths.motion import constant_velocity, constant_velocity_noise
from visfuse_cli.records import Gaussian, Lens, View
from visfuse_cli.vision.matching import agree

pytestmark = pytest.mark.geometry


def ring(count: int = 4, far: float = 7.0, high: float = 3.0) -> np.ndarray:
    """Projections (C, 3, 4) of cameras around the origin that look at (0, 0, 0.9)."""
    found = []
    for angle in np.arange(count) * 2 * np.pi / count + 0.3:
        centre = np.array([far * np.cos(angle), far * np.sin(angle), high])
        axis = np.array([0, 0, 0.9]) - centre
        axis /= np.linalg.norm(axis)
        right = np.cross(axis, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(axis, right), axis])
        K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
        view = View("c", Lens(K, np.zeros(5)), (640, 480), R, -R @ centre)
        found.append(multiview.projection(view))
    return np.stack(found)


def seen(P: np.ndarray, point: np.ndarray) -> np.ndarray:
    return multiview.project(P, point)[0]


def test_points_are_triangulated_exactly_and_their_covariance_is_that_of_the_noise():
    P, point = ring(), np.array([0.7, -0.4, 1.1])
    z = seen(P, point)
    np.testing.assert_allclose(triangulation.linear(P, z), point, atol=1e-9)
    R = np.tile(4.0 * np.eye(2), (4, 1, 1))
    rng = np.random.default_rng(1)
    noisy = z + 2.0 * rng.normal(size=(4000, 4, 2))
    found, chi2 = triangulation.triangulate(
        np.broadcast_to(P, (4000, 4, 3, 4)), noisy, np.broadcast_to(R, (4000, 4, 2, 2))
    )
    off = found.mean - point
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.cov), off)
    assert abs(nees.mean() - 3) < 0.12
    assert abs(chi2.sum(axis=1).mean() - 5) < 0.2


def test_the_epipolar_distance_of_two_views_of_one_point_is_zero_and_grows_with_their_disagreement():
    P, point = ring(), np.array([[0.5, 0.2, 1.0]])
    z = seen(P, point)
    F = multiview.fundamental(P[0], P[1])
    assert abs(multiview.epipolar_distance(F, z[0], z[1])) < 1e-9
    normal = np.array([0.0, 10.0])
    assert abs(multiview.epipolar_distance(F, z[0] + normal, z[1])) > 1


def test_of_views_that_disagree_the_wrong_one_is_dropped():
    P = ring()
    z = seen(P, np.array([0.2, 0.3, 0.9]))
    z[2] += [60.0, 5.0]
    point, used = agree(P, z, np.tile(9.0 * np.eye(2), (4, 1, 1)))
    assert used.tolist() == [True, True, False, True]
    np.testing.assert_allclose(point.mean, [0.2, 0.3, 0.9], atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4), st.floats(-3, 3))
def test_the_ground_is_turned_to_z_0_and_back(plane, d):
    plane = np.array([*plane[:3], d])
    if np.linalg.norm(plane[:3]) < 0.1:
        return
    R, t = multiview.ground_from_world(plane)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    point = np.array([0.3, 1.2, -0.7])
    assert (R @ point + t)[2] == pytest.approx((plane[:3] @ point + plane[3]) / np.linalg.norm(plane[:3]))


def test_one_pair_is_that_pairs_kalman_filter():
    prior = Gaussian(np.array([[0.1, 0.2, 0.9, 0.5, 0.0, 0.0]]), np.eye(6)[None] * 0.3)
    y, R = np.array([[0.3, 0.1, 1.0]]), np.diag([0.01, 0.02, 0.03])[None]
    loop = fusion.closed_loop(prior, np.zeros(1, dtype=int), y, R)
    kalman, _ = gaussian.update(prior, y - prior.mean[:, :3], fusion.position(6), R)
    np.testing.assert_allclose(loop.mean, kalman.mean, atol=1e-12)
    np.testing.assert_allclose(loop.cov, kalman.cov, atol=1e-12)


def test_who_was_measured_by_nobody_keeps_the_prediction():
    prior = Gaussian(np.zeros((2, 6)), np.tile(np.eye(6), (2, 1, 1)))
    loop = fusion.closed_loop(prior, np.array([1]), np.ones((1, 3)), 0.1 * np.eye(3)[None])
    np.testing.assert_array_equal(loop.mean[0], 0)
    np.testing.assert_array_equal(loop.cov[0], np.eye(6))
    assert loop.mean[1, 0] > 0.5


def simulate(methods: list[str], runs: int = 60, steps: int = 40, seed: int = 3) -> dict[str, tuple[float, float]]:
    """Mean squared position error and NEES of each method, on the same walks before four cameras."""
    rng = np.random.default_rng(seed)
    P, dt, cameras = ring(), 0.05, 4
    F, Q = constant_velocity(dt, 3), constant_velocity_noise(dt, 0.8, 3)
    sigma = np.array([1.5, 2.0, 3.0, 4.0])
    half = np.linalg.cholesky(Q + 1e-15 * np.eye(6))
    start = np.diag([0.1, 0.1, 0.1, 0.5, 0.5, 0.1]) ** 2
    truth = np.array([0, 0, 0.9, 0, 0, 0]) + rng.normal(size=(runs, 6)) * np.sqrt(np.diag(start))
    belief = {m: Gaussian(np.tile([0, 0, 0.9, 0, 0, 0.0], (runs, 1)), np.tile(start, (runs, 1, 1))) for m in methods}
    banks = {m: [None] * runs for m in methods}
    square, nees = dict.fromkeys(methods, 0.0), dict.fromkeys(methods, 0.0)
    owner, camera = np.repeat(np.arange(runs), cameras), np.tile(np.arange(cameras), runs)
    R = np.tile(sigma[camera, None, None] ** 2 * np.eye(2), (1, 1, 1))
    for _ in range(steps):
        truth = truth @ F.T + rng.normal(size=(runs, 6)) @ half.T
        z = seen(P[camera], truth[owner, :3]) + rng.normal(size=(len(owner), 2)) * sigma[camera, None]
        sights = Sights(owner, camera, z, R, np.zeros(len(owner)))
        for m in methods:
            ahead = gaussian.predict(belief[m], F, Q)
            banks[m] = [b if b is None else fusion_rivals.predicted(b, F, Q) for b in banks[m]]
            belief[m] = fuse(m, ahead, sights, P, banks[m])
            off = truth - belief[m].mean
            square[m] += float(np.mean(np.sum(off[:, :3] ** 2, axis=1))) / steps
            nees[m] += float(np.mean(np.einsum("ti,tij,tj->t", off, np.linalg.inv(belief[m].cov), off))) / steps
    return {m: (square[m], nees[m]) for m in methods}


def test_the_closed_loop_reaches_the_centralised_bound_and_knows_its_error():
    found = simulate(["central", "closed-loop", "naive", "kim", "covariance-intersection"])
    bound = found["central"][0]
    # 60 runs of 40 correlated steps: the mean NEES of 6 degrees of freedom scatters by about 0.3
    assert found["closed-loop"][0] < 1.02 * bound
    assert 5.0 < found["closed-loop"][1] < 7.0
    assert 5.0 < found["central"][1] < 7.0
    assert found["naive"][1] > 8.5  # counts every camera three times, and the motion's noise once a pair
    for rival in ("naive", "kim", "covariance-intersection"):
        assert found["closed-loop"][0] <= 1.005 * found[rival][0], rival
