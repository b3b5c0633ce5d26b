"""Mean speed over a stretch: length of smooth paths, and intervals that hold the truth as often as they say."""

import numpy as np
import pytest

from tests.drives import bicycle_run
from visfuse_cli.errors import InputError
from visfuse_cli.maths import motion, smoothing, speed


def circle(radius: float, turn: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    angle = np.linspace(0, turn, count)
    positions = radius * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    return positions, np.column_stack([np.cos(angle), np.sin(angle)])


def test_length_of_an_arc_is_exact_at_any_sampling():
    for count in (3, 8, 50):
        assert speed.path_length(*circle(7.0, 2.0, count)) == pytest.approx(14.0, rel=1e-12)


def test_the_way_adds_up_state_by_state():
    positions, tangents = circle(7.0, 2.0, 8)
    np.testing.assert_allclose(speed.way(positions, tangents), np.linspace(0, 14, 8), atol=1e-12)
    np.testing.assert_array_equal(speed.way(positions[:1], tangents[:1]), [0.0])


def test_sideways_noise_does_not_lengthen_the_path():
    rng = np.random.default_rng(1)
    positions = np.column_stack([np.linspace(0, 20, 200), 0.2 * rng.normal(size=200)])
    tangents = np.tile([1.0, 0.0], (200, 1))
    assert speed.path_length(positions, tangents) == pytest.approx(20.0, rel=1e-12)
    polyline = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    assert polyline > 30


def test_reversing_adds_to_the_way():
    x = np.concatenate([np.linspace(0, 10, 21), np.linspace(9.5, 4, 12)])
    tangents = np.where(np.arange(33) <= 20, 1.0, -1.0)[:, None] * [1.0, 0.0]
    assert speed.path_length(np.column_stack([x, 0 * x]), tangents) == pytest.approx(16.0)


def test_a_car_that_stands_has_no_speed_and_no_nan():
    value, sigma, _ = speed.mean_speed(np.arange(5.0), np.ones((5, 2)), np.zeros((5, 2)), 0.01)
    assert value == 0
    assert sigma == pytest.approx(0.1 / 4)


def test_gradient_of_the_length_equals_central_differences():
    positions, tangents = circle(12.0, 1.2, 9)
    expected = np.zeros_like(positions)
    for k in np.ndindex(positions.shape):
        step = np.zeros_like(positions)
        step[k] = 1e-5
        expected[k] = speed.path_length(positions + step, tangents) - speed.path_length(positions - step, tangents)
    np.testing.assert_allclose(speed.length_gradient(positions, tangents), expected / 2e-5, atol=1e-8)


def test_correlated_ends_cancel():
    tangents, P = np.array([[1.0, 0], [1.0, 0]]), np.diag([0.04, 0.09])
    assert speed.end_variance(tangents, P, P) == pytest.approx(0.08)
    assert speed.end_variance(tangents, P, P, P) == 0


def test_on_a_straight_path_the_ends_say_what_all_states_say():
    rng = np.random.default_rng(2)
    _, filtered, predicted, F = bicycle_run(rng, 1, 40, 0.04)
    smoothed = smoothing.rauch_tung_striebel(filtered, predicted, F, angles=(3,))
    tangents = np.tile([1.0, 0.0], (40, 1))
    weights = np.zeros((40, 1, 5))
    weights[:, 0, :2] = speed.length_gradient(smoothed.mean[:, 0, :2], tangents)
    cross = smoothing.cross_covariance(smoothed, 0, 39)[0, :2, :2]
    ends = speed.end_variance(tangents, smoothed.cov[0, 0, :2, :2], smoothed.cov[-1, 0, :2, :2], cross)
    assert smoothing.weighted_variance(smoothed, weights)[0] == pytest.approx(ends, rel=1e-9)


def test_pose_intervals_hold_the_truth_on_matched_drives():
    runs, steps, dt = 300, 50, 0.04
    truth, filtered, predicted, F = bicycle_run(np.random.default_rng(3), runs, steps, dt)
    smoothed = smoothing.rauch_tung_striebel(filtered, predicted, F, angles=(3,))
    t, score = np.arange(steps) * dt, []
    for car in range(runs):
        velocity = motion.bicycle_velocity(smoothed.mean[:, car])[0]
        tangents = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
        positions = smoothed.mean[:, car, :2]
        one = smoothing.Smoothed(smoothed.mean[:, car], smoothed.cov[:, car], smoothed.gains[:, car])
        weights = np.zeros((steps, 5))
        weights[:, :2] = speed.length_gradient(positions, tangents)
        value, sigma, _ = speed.mean_speed(t, positions, tangents, float(smoothing.weighted_variance(one, weights)))
        true_velocity = motion.bicycle_velocity(truth[:, car])[0]
        true_tangents = true_velocity / np.linalg.norm(true_velocity, axis=1, keepdims=True)
        score.append((value - speed.path_length(truth[:, car, :2], true_tangents) / t[-1]) / sigma)
    assert 0.91 < np.mean(np.abs(score) < 1.96) < 0.985
    assert abs(np.mean(score)) < 0.2


def test_calibration_and_time_stamps_enter_the_interval():
    # A map whose scale alone is uncertain by 2 %: ground = h0 * image.
    positions = np.column_stack([np.linspace(0, 30, 31), np.zeros(31)])
    tangents = np.tile([1.0, 0.0], (31, 1))
    J = np.zeros((31, 2, 9))
    J[:, :, 0] = positions
    cov = np.zeros((9, 9))
    cov[0, 0] = 0.02**2
    value, sigma, parts = speed.mean_speed(np.linspace(0, 3, 31), positions, tangents, 0.03**2, J, cov, 0.001)
    assert value == pytest.approx(10.0)
    assert parts["pose"] == pytest.approx(0.01)
    assert parts["calibration"] == pytest.approx(0.2)
    assert parts["time"] == pytest.approx(np.sqrt(2) * 10 * 0.001 / 3)
    assert sigma == pytest.approx(np.sqrt(sum(p**2 for p in parts.values())))


@pytest.mark.parametrize("stamps", [[], [1.0], [1.0, 1.0]])
def test_a_stretch_without_duration_is_refused(stamps: list[float]):
    n = len(stamps)
    with pytest.raises(InputError, match="two states at different times"):
        speed.mean_speed(np.array(stamps), np.zeros((n, 2)), np.zeros((n, 2)), 0.0)
