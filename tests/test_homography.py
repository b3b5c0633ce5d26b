"""Homographies against known cameras: exact without noise, honest about it with."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.cameras import ground_points, image_from_ground
from visfuse_cli.errors import InputError
from visfuse_cli.maths import gaze
from visfuse_cli.maths.calibration_error import speed_error
from visfuse_cli.maths.homography import apply, depth, entry_jacobian, invert, jacobian
from visfuse_cli.maths.homography_fit import fit_points
from visfuse_cli.maths.lines import fit_lines
from visfuse_cli.records import GroundMap

TRUE = image_from_ground()
GROUND_FROM_IMAGE = np.linalg.inv(TRUE) / np.linalg.inv(TRUE)[2, 2]
# a court of painted lines on the ground: X1, Y1, X2, Y2
COURT = np.array([[-5, 12, -5, 40], [5, 12, 5, 40], [-5, 14, 5, 14], [-5, 38, 5, 38], [-5, 26, 5, 26], [0, 14, 3, 38]])

pytestmark = pytest.mark.geometry


def survey(n: int, seed: int = 0, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    world = ground_points(rng, n)
    return apply(TRUE, world) + noise * rng.normal(size=(n, 2)), world


def drawn(world_lines: np.ndarray, shares: tuple[float, float] = (0.1, 0.8)) -> np.ndarray:
    """Two points of each world line's image (n, 4), not the images of its ends."""
    ends = world_lines.reshape(-1, 2, 2)
    marks = [apply(TRUE, ends[:, 0] + share * (ends[:, 1] - ends[:, 0])) for share in shares]
    return np.hstack(marks)


@pytest.mark.parametrize("n", [4, 5, 8, 30])
def test_rendered_points_give_the_camera_back(n: int):
    image, world = survey(n)
    fit = fit_points(image, world)
    np.testing.assert_allclose(fit.H, GROUND_FROM_IMAGE, rtol=1e-9, atol=1e-9 * np.abs(GROUND_FROM_IMAGE).max())
    assert fit.H[2, 2] == 1
    assert fit.rms_m < 1e-9
    assert fit.rms_px < 1e-9
    assert np.all(np.sign(depth(fit.H, image)) == fit.ground_sign)


def test_rendered_lines_give_the_same_map_as_points():
    fit = fit_lines(drawn(COURT), COURT)
    np.testing.assert_allclose(fit.H, GROUND_FROM_IMAGE, rtol=1e-9, atol=1e-9 * np.abs(GROUND_FROM_IMAGE).max())
    np.testing.assert_allclose(fit.H, fit_points(*survey(8)).H, rtol=1e-8, atol=1e-8)


def test_four_lines_suffice_and_leave_nothing_to_check():
    fit = fit_lines(drawn(COURT[:4]), COURT[:4])
    np.testing.assert_allclose(fit.H, GROUND_FROM_IMAGE, rtol=1e-8, atol=1e-8 * np.abs(GROUND_FROM_IMAGE).max())
    assert np.isnan(fit.leave_one_out_m).all()


def test_a_line_error_is_the_rms_distance_of_its_two_points():
    image = drawn(COURT)
    fit = fit_lines(image, COURT, robust=2.0)
    image[4, 1] += 9.0
    moved = fit_lines(image, COURT, robust=2.0)
    assert list(np.flatnonzero(~moved.used)) == [4]
    direction = image[4, 2:] - image[4, :2] + [0, 9.0]
    across = 9.0 * abs(direction[0]) / np.hypot(*direction)
    np.testing.assert_allclose(moved.error_px[4], across / np.sqrt(2), rtol=1e-6)
    np.testing.assert_allclose(moved.H, fit.H, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("order", gaze.ORDERS)
def test_gaze_angles_of_a_rendered_point(order: str):
    """A head that turns by these angles, axis by axis, looks at the point."""
    rng = np.random.default_rng(3)
    for elevation, vergence in rng.uniform(-1.2, 1.2, (20, 2)):
        ce, se, cv, sv = np.cos(elevation), np.sin(elevation), np.cos(vergence), np.sin(vergence)
        about_left = np.array([[1, 0, 0], [0, ce, se], [0, -se, ce]])  # axes left, up, ahead: ahead goes up
        about_up = np.array([[cv, 0, sv], [0, 1, 0], [-sv, 0, cv]])  # ahead goes left
        turned = about_left @ about_up if order == gaze.ORDERS[0] else about_up @ about_left
        ray = turned @ [0, 0, 1]
        point = gaze.frontal(np.array([elevation]), np.array([vergence]), order)
        np.testing.assert_allclose(point[0], ray[:2] / ray[2], rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(np.ravel(gaze.angles(point, order)), [elevation, vergence], rtol=1e-12, atol=1e-14)


def test_the_frontal_plane_is_the_image_turned_round():
    """u right and v down are the negatives of left and up: K = 1 takes one to the other."""
    camera = image_from_ground(focal=1.0, principal=(0.0, 0.0))
    pixels = apply(camera, np.array([[-2.0, 20.0], [3.0, 15.0]]))
    elevation, vergence = gaze.angles(-pixels)
    assert vergence[0] > vergence[1], "the left point needs the greater vergence"
    assert elevation[0] > elevation[1], "the far point needs the greater elevation"


def test_gaze_noise_is_counted_in_radians_at_wide_angles_too():
    """Points seen at up to 80 degrees: a milliradian there is 30 times as much on the frontal plane."""
    truth = np.array([[0.0, 2.0, 9.0], [1.5, 0.1, 4.0], [0.02, -0.3, 1.0]])
    elevation, vergence = np.array([(e, v) for e in (-0.6, -0.3, 0.0) for v in (-1.4, -0.5, 0.5, 1.4)]).T
    points = gaze.frontal(elevation, vergence)
    world = apply(truth, points)
    keep = depth(truth, points) > 0.1
    rng = np.random.default_rng(1)
    noisy = gaze.frontal(*(angle[keep] + 1e-3 * rng.normal(size=keep.sum()) for angle in (elevation, vergence)))
    fit = fit_points(noisy, world[keep], 1e-3, measured=lambda p: np.column_stack(gaze.angles(p)))
    assert 0.5e-3 < fit.rms_px < 2e-3
    assert 0.5e-3 < fit.sigma_px < 2e-3


def test_image_corner_on_the_horizon():
    """Where H[2][2] is 0 the norm is 1 instead, with a covariance that says the same about the ground."""
    pitch = 0.35
    camera = image_from_ground(pitch=pitch, yaw=0.0, principal=(639.5, 1000 * np.tan(pitch)))
    world = ground_points(np.random.default_rng(0), 12)
    image = apply(camera, world)
    assert abs(np.linalg.inv(camera)[2, 2]) < 1e-15
    fit = fit_points(image, world)
    assert np.linalg.norm(fit.H) == pytest.approx(1, abs=1e-12)
    assert abs(fit.H[2, 2]) < 1e-9
    np.testing.assert_allclose(apply(fit.H, image), world, atol=1e-9)
    assert np.all(np.sign(depth(fit.H, image)) == fit.ground_sign)
    moved = fit_points(image + [0, 5], world)  # the same camera, its corner five pixels off the horizon
    assert moved.H[2, 2] == 1
    here, there = (
        np.einsum("nik,kl,njl->nij", J, f.cov, J)
        for f, J in ((fit, entry_jacobian(fit.H, image)), (moved, entry_jacobian(moved.H, image + [0, 5])))
    )
    np.testing.assert_allclose(here, there, rtol=1e-4)


@pytest.mark.parametrize("corner_on_horizon", [False, True])
def test_covariance_has_rank_eight_and_its_null_is_what_the_scale_holds(corner_on_horizon: bool):
    camera = image_from_ground(yaw=0.0, principal=(639.5, 1000 * np.tan(0.35))) if corner_on_horizon else TRUE
    world = ground_points(np.random.default_rng(0), 12)
    fit = fit_points(apply(camera, world), world)
    held = fit.H.ravel() if corner_on_horizon else np.eye(9)[8]
    sizes = np.sqrt(np.maximum(np.diag(fit.cov), 1e-300))
    assert np.abs(fit.cov @ held).max() < 1e-6 * sizes.max() ** 2
    spread = fit.cov / np.outer(sizes, sizes) if corner_on_horizon else (fit.cov / np.outer(sizes, sizes))[:8, :8]
    values = np.linalg.eigvalsh(spread)
    assert np.sum(values > 1e-13 * values[-1]) >= 7
    np.testing.assert_array_equal(fit.cov, fit.cov.T)


@pytest.mark.parametrize("kind", ["points", "lines"])
def test_covariance_against_monte_carlo(kind: str):
    """Where ground points land under 300 draws of pixel noise, and what the covariance said."""
    sigma, draws = 0.5, 300
    world = survey(7)[1] if kind == "points" else COURT
    image = apply(TRUE, world) if kind == "points" else drawn(COURT)
    solve = fit_points if kind == "points" else fit_lines
    claimed = solve(image, world, sigma)
    targets = apply(TRUE, np.array([[0.0, 20.0], [-3.0, 35.0], [4.0, 15.0]]))
    J = entry_jacobian(claimed.H, targets)
    expected = np.einsum("nik,kl,njl->nij", J, claimed.cov, J)
    rng = np.random.default_rng(5)
    landed = np.array([apply(solve(image + sigma * rng.normal(size=image.shape), world, sigma).H, targets)
                       for _ in range(draws)])  # fmt: skip
    for k in range(len(targets)):
        ratio = np.linalg.solve(expected[k], np.cov(landed[:, k].T))
        assert np.trace(ratio) / 2 == pytest.approx(1, abs=0.2)
        np.testing.assert_allclose(np.linalg.eigvals(ratio).real, 1, atol=0.35)


def test_noise_is_estimated_where_there_is_enough_to_tell():
    estimates = [fit_points(*survey(20, seed, noise=0.4), 1.0).sigma_px for seed in range(20)]
    assert np.sqrt(np.mean(np.square(estimates))) == pytest.approx(0.4, rel=0.1)


def test_few_points_keep_the_stated_noise_unless_they_contradict_it():
    assert fit_points(*survey(4), 0.7).sigma_px == 0.7
    assert fit_points(*survey(6), 0.7).sigma_px == 0.7
    image, world = survey(6)
    image[0] += [20.0, 20.0]
    assert fit_points(image, world, 0.7).sigma_px > 1.5


def test_a_perfect_fit_does_not_promise_perfection():
    fit = fit_points(*survey(20), 1.0)
    assert fit.sigma_px == pytest.approx(0.1)
    assert np.trace(fit.cov) > 0


def test_leave_one_out_is_what_the_others_say():
    image, world = survey(7, noise=1.0)
    fit = fit_points(image, world)
    for k in range(7):
        others = np.arange(7) != k
        without = fit_points(image[others], world[others])
        missed = np.linalg.norm(apply(without.H, image[k : k + 1]) - world[k])
        assert fit.leave_one_out_m[k] == pytest.approx(missed, rel=1e-6)


def test_leave_one_out_is_impossible_with_four():
    assert np.isnan(fit_points(*survey(4)).leave_one_out_m).all()


@pytest.mark.parametrize("n", [8, 40, 120])
def test_robust_names_the_wrong_points(n: int):
    image, world = survey(n, noise=0.3)
    image[0] += 60
    image[3] = [600.0, -900.0]  # in the sky
    fit = fit_points(image, world, 1.0, robust=4.0)
    assert list(np.flatnonzero(~fit.used)) == [0, 3]
    good = fit.used
    np.testing.assert_allclose(fit.H, fit_points(image[good], world[good]).H, rtol=1e-6, atol=1e-7)
    again = fit_points(image, world, 1.0, robust=4.0)
    np.testing.assert_array_equal(fit.H, again.H)


def test_far_away_world_origin_changes_nothing_but_the_offset():
    image, world = survey(10, noise=0.5)
    here, there = fit_points(image, world), fit_points(image, world + [4000.0, -7000.0])
    assert there.H[2, 2] == 1
    np.testing.assert_allclose(apply(there.H, image), apply(here.H, image) + [4000, -7000], atol=1e-6)
    ours, theirs = (
        np.einsum("nik,kl,njl->nij", J, f.cov, J) for f in (here, there) for J in [entry_jacobian(f.H, image)]
    )
    np.testing.assert_allclose(theirs, ours, rtol=1e-3, atol=1e-7)


@settings(max_examples=25, deadline=None)
@given(
    scale=st.floats(0.01, 100), turn=st.floats(-3.1, 3.1), du=st.floats(-500, 500), dv=st.floats(-500, 500),
    flip=st.booleans(),
)  # fmt: skip
def test_similarities_of_either_plane_go_through(scale: float, turn: float, du: float, dv: float, flip: bool):
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    T = np.array([[c, -s, du], [s, c, dv], [0, 0, 1.0]]) @ np.diag([-1.0 if flip else 1.0, 1, 1])
    image, world = survey(9, noise=0.5)
    fit = fit_points(image, world)
    moved_world = fit_points(image, apply(T, world))
    np.testing.assert_allclose(apply(moved_world.H, image), apply(T, apply(fit.H, image)), rtol=1e-6, atol=1e-6)
    moved_image = fit_points(apply(T, image), world)
    np.testing.assert_allclose(apply(moved_image.H, apply(T, image)), apply(fit.H, image), rtol=1e-5, atol=1e-5)
    assert moved_image.rms_px == pytest.approx(scale * fit.rms_px, rel=1e-5)
    assert np.all(np.sign(depth(moved_image.H, apply(T, image))) == moved_image.ground_sign)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), n=st.integers(4, 12))
def test_the_order_of_the_rows_does_not_matter(seed: int, n: int):
    image, world = survey(n, seed, noise=0.3)
    order = np.random.default_rng(seed).permutation(n)
    a, b = fit_points(image, world), fit_points(image[order], world[order])
    np.testing.assert_allclose(a.H, b.H, rtol=1e-5, atol=1e-6 * np.abs(a.H).max())
    np.testing.assert_allclose(a.error_m[order], b.error_m, atol=1e-6)


SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [0.3, 0.6]])


@pytest.mark.parametrize(
    ("image", "world", "message"),
    [
        (SQUARE[:3] * 100, SQUARE[:3], "four points or more, not 3"),
        (SQUARE[[0, 1, 2, 3, 3]] * 100, SQUARE, "points 4 and 5 are the same point in the image"),
        (SQUARE * 100, SQUARE[[0, 1, 2, 1, 4]], "points 2 and 4 are the same point on the ground"),
        (SQUARE[[0, 1, 2, 1]] * 100, SQUARE[[0, 1, 2, 1]], "points 2 and 4 are the same point in the image"),
        (np.outer(np.arange(5), [100.0, 30.0]), SQUARE, "on one line in the image"),
        (SQUARE * 100, np.outer(np.arange(5), [1.0, 3.0]), "on one line on the ground"),
        (np.array([[0.0, 0], [50, 0], [100, 0], [30, 80]]), SQUARE[:4], "all points but one lie on one line in the im"),
        (SQUARE[:4] * 100, np.array([[0.0, 0], [5, 5], [9, 9], [1, 7]]), "all points but one lie on one line on the"),
        (np.array([[0.0, 0], [50, 0], [100, 0], [150, 0], [30, 80]]), SQUARE, "all points but one"),
        (SQUARE[:4] * 100, SQUARE[[0, 2, 1, 3]], "both sides of the horizon"),
    ],
)  # fmt: skip
def test_points_that_cannot_carry_a_homography_are_refused(image: np.ndarray, world: np.ndarray, message: str):
    with pytest.raises(InputError, match=message):
        fit_points(image, world)


def test_nearly_degenerate_points_are_refused_with_the_condition_number():
    image, world = survey(5)
    with pytest.raises(InputError, match=r"nearly degenerate \(condition number .*limit 5e\+00\)"):
        fit_points(image, world, condition_limit=5.0)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (COURT[:3], "four lines or more, not 3"),
        (COURT[[0, 1, 2, 2]], "lines 3 and 4 are the same line"),
        (COURT[[2, 3, 4, 0]], "all lines but one are parallel or go through one point"),
        (np.array([[0, 20, 5, 30], [0, 20, -5, 30], [0, 20, 1, 40], [0, 20, 5, 21]]), "parallel or go through one"),
        (np.array([[0, 20, 0, 20], *COURT[:3]]), "line 1 has no length"),
    ],
)
def test_lines_that_cannot_carry_a_homography_are_refused(lines: np.ndarray, message: str):
    with pytest.raises(InputError, match=message):
        fit_lines(drawn(lines), lines.astype(float))


def test_derivatives_against_differences():
    H = GROUND_FROM_IMAGE
    points = survey(4)[0]
    step = 1e-4
    for axis in range(2):
        move = np.eye(2)[axis] * step
        numeric = (apply(H, points + move) - apply(H, points - move)) / (2 * step)
        np.testing.assert_allclose(jacobian(H, points)[:, :, axis], numeric, rtol=1e-6, atol=1e-9)
    for entry in range(9):
        size = 1e-6 * max(abs(H.flat[entry]), 1e-4)
        move = np.eye(9)[entry].reshape(3, 3) * size
        numeric = (apply(H + move, points) - apply(H - move, points)) / (2 * size)
        np.testing.assert_allclose(entry_jacobian(H, points)[:, :, entry], numeric, rtol=1e-4, atol=1e-6)


def test_invert_maps_back():
    points = survey(5)[0]
    np.testing.assert_allclose(apply(invert(GROUND_FROM_IMAGE), apply(GROUND_FROM_IMAGE, points)), points, rtol=1e-9)


def test_expected_speed_error_against_monte_carlo():
    """Both ends of a second's way through one noisy map: their common error cancels, as the formula has it."""
    sigma = 0.5
    image, world = survey(7)
    claimed = fit_points(image, world, sigma)
    ground = GroundMap(claimed.H, claimed.cov, claimed.ground_sign, "pixel", None, None, 0.0, 0.0)
    middle = apply(TRUE, np.array([[0.0, 24.0]]))
    expected = speed_error(ground, middle, sigma)[0]
    rng = np.random.default_rng(2)
    angles = np.arange(4) * np.pi / 4
    along = np.column_stack([np.cos(angles), np.sin(angles)]) * 50 / 3.6 / 2
    ends = apply(TRUE, np.concatenate([[0, 24] - along, [0, 24] + along]))
    speeds = []
    for _ in range(300):
        H = fit_points(image + sigma * rng.normal(size=image.shape), world, sigma).H
        moved = apply(H, ends + sigma * rng.normal(size=ends.shape))
        speeds.append(np.linalg.norm(moved[4:] - moved[:4], axis=1) * 3.6)
    assert expected == pytest.approx(np.std(speeds, axis=0).max(), rel=0.12)
    assert np.isnan(speed_error(ground, np.array([[640.0, -900.0]]), sigma)).all(), "above the horizon"
