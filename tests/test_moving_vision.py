"""What moving and turning heads measure: disparity of a region, looks, patches at the edge, flow as a camera turns."""

import cv2
import numpy as np
import pytest

from samples.casting import Plane, camera_rays, cast, wall
from visfuse_cli.gazing.head import rest
from visfuse_cli.moving.journey import journey
from visfuse_cli.moving.settings import OdometrySettings
from visfuse_cli.records import GroundMap, Lens
from visfuse_cli.vision import clusters, normal_flow, patches
from visfuse_cli.vision.disparity import region_shift
from visfuse_cli.vision.looks import looks, unlike

pytestmark = pytest.mark.geometry
BOX = np.array([[80.0, 40], [130, 40], [130, 140], [80, 140]])
K = np.array([[200.0, 0, 120], [0, 200, 90], [0, 0, 1]])


def texture(seed, size=(180, 240)):
    grain = cv2.GaussianBlur(np.random.default_rng(seed).uniform(0, 255, (*size, 3)).astype(np.float32), (0, 0), 2.0)
    return np.clip((grain - 127) * 4 + 127, 0, 255).astype(np.uint8)


def shifted(picture, by):
    M = np.array([[1.0, 0, by[0]], [0, 1, by[1]]])
    size = picture.shape[1], picture.shape[0]
    return cv2.warpAffine(picture, M, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize("true", [-6.0, -6.3, -7.5])
def test_a_regions_disparity_is_found_to_parts_of_a_pixel(true):
    left = texture(1)
    right = np.clip(shifted(left, (true, 0)).astype(int) + 12, 0, 255).astype(np.uint8)  # another exposure, too
    found, variance = region_shift({"left": left, "right": right}, BOX, BOX + [-7.0, 0], np.array([-1.0, 0]), 3.0)
    assert (found - BOX)[:, 0].mean() == pytest.approx(true, abs=0.06)
    assert 0 < variance[0] < 0.1


def test_a_region_that_is_not_in_the_other_view_has_no_disparity():
    views = {"left": texture(1), "right": texture(2)}
    assert region_shift(views, BOX, BOX + [-7.0, 0], np.array([-1.0, 0]), 3.0) is None


def test_things_are_known_by_their_looks_and_not_by_the_light():
    one, other = texture(3), texture(4)
    one[90:] //= 3
    other[:90] //= 3
    darker = (one * 0.9).astype(np.uint8)
    same, different = (unlike(looks(one, BOX), looks(picture, BOX)) for picture in (darker, other))
    assert same < 10
    assert different > 3 * same


def test_a_patch_partly_out_of_view_is_followed_and_one_mostly_out_is_not():
    picture = texture(5)
    levels = patches.pyramid(picture)
    sought = patches.template(levels, BOX)
    moved = patches.pyramid(shifted(picture, (-96.0, 0)))  # a third of the patch has left
    found = patches.follow(moved, BOX - [94.5, 0], sought, 0.05, 0.6)
    assert found is not None
    np.testing.assert_allclose(found.shift, [-1.5, 0], atol=0.1)
    gone = patches.pyramid(shifted(picture, (-115.0, 0)))
    assert patches.follow(gone, BOX - [115.0, 0], sought, 0.05, 0.6) is None


def test_a_plain_patch_is_held_by_its_outline():
    picture = np.full((180, 240, 3), 60, np.uint8)
    picture[40:140, 80:130] = 180
    levels = patches.pyramid(picture)
    assert patches.template(levels, BOX).values.std() < 1
    sought = patches.holding(levels, BOX)
    found = patches.follow(patches.pyramid(shifted(picture, (3.0, 0))), BOX, sought, 0.05, 0.6)
    np.testing.assert_allclose(found.shift, [3.0, 0], atol=0.1)


def test_before_a_turning_camera_a_static_scene_leaves_no_flow():
    planes = [Plane(1, 2.0, (0, 2), wall(3, 0)), Plane(2, 8.0, (0, 1), wall(3, 1))]
    rays = camera_rays(K, np.zeros(5), (240, 180))
    turn = cv2.Rodrigues(np.array([0.01, -0.03, 0.0]))[0]
    seen = [cv2.resize(cast(rays @ R.T, np.zeros(3), planes, []), (240, 180), interpolation=cv2.INTER_AREA)
            for R in (np.eye(3), turn)]  # fmt: skip
    before, after = (np.clip(picture.mean(axis=2), 0, 255).astype(np.uint8) for picture in seen)
    turned, known = normal_flow.turned(before, turn.T, K)
    flow, gradient = normal_flow.normal_flow(turned, after, 1.0)
    usable = (gradient > normal_flow.LEAST_GRADIENT) & (known > 0)
    assert np.count_nonzero(usable) > 1000
    assert np.median(np.linalg.norm(flow[usable], axis=1)) < 0.1
    still, slope = normal_flow.normal_flow(before, after, 1.0)
    assert np.median(np.linalg.norm(still[slope > normal_flow.LEAST_GRADIENT], axis=1)) > 0.5


def test_a_shift_that_all_agree_on_is_taken_out_of_normal_flow():
    before = cv2.cvtColor(texture(6), cv2.COLOR_BGR2GRAY)
    after = shifted(before, (0.6, -0.3))
    flow, gradient = normal_flow.normal_flow(before, after, 1.0)
    known = np.full(before.shape, 255, np.uint8)
    usable = gradient > normal_flow.LEAST_GRADIENT
    left = normal_flow.steadied(flow, gradient, known)[usable]
    assert np.median(np.linalg.norm(left, axis=1)) < 0.15 * np.median(np.linalg.norm(flow[usable], axis=1))


def test_a_homography_from_pixels_is_that_of_the_head_at_rest():
    lens = Lens(K, np.zeros(5))
    tilt = cv2.Rodrigues(np.array([-0.4, 0.0, 0.0]))[0]  # looks down; level axes: x right, y down, z ahead
    image_from_ground = K @ tilt.T @ np.array([[1.0, 0, 0], [0, 0, 3.0], [0, 1, 0]])  # X right, Y ahead, 3 m above
    H = np.linalg.inv(image_from_ground)
    H /= H[2, 2]
    sign = int(np.sign((H @ [120, 170, 1])[2]))
    by_pixel = GroundMap(H, 1e-12 * np.eye(9), sign, "pixel", (240, 180), None, 0.0, 0.0)
    ground, head = rest(by_pixel, lens, "elevation-vergence", "H.json", (240, 180))
    assert ground.input == "gaze"
    np.testing.assert_allclose(head.centre, [0, 0, 3], atol=1e-9)
    pixel = np.array([150.0, 160.0])
    place = H @ np.append(pixel, 1)
    np.testing.assert_allclose(head.ground(pixel, np.zeros(2), 0.0), place[:2] / place[2], atol=1e-9)
    # What the head turns to is what it sees in its middle: (tan v / cos e, tan e, 1), left and up.
    gaze = np.array([-0.2, 0.3])
    frontal = np.array([np.tan(gaze[1]) / np.cos(gaze[0]), np.tan(gaze[0]), 1.0])
    aimed = ground.ground_from_image @ frontal
    np.testing.assert_allclose(head.ground(K[:2, 2], gaze, 0.0), aimed[:2] / aimed[2], atol=1e-9)


def test_tachometers_wheels_and_poses_tell_one_way():
    settings = OdometrySettings(k_t=0.5, wheel_separation=0.6, camera_yaw=0.2, camera_offset=(0.1, -0.3, 0.4))
    t = np.linspace(0, 4, 201)
    v1, v2 = 1 + 0.2 * np.sin(t), 1.1 + 0.1 * np.cos(2 * t)
    by_wheels = journey("wheels", {"t": t, "v1": v1, "v2": v2}, settings)
    by_volts = journey("volts", {"t": t, "u1": v1 / 0.5, "u2": v2 / 0.5}, settings)
    poses = [by_wheels(float(now)) for now in t]
    columns = {"t": t, "theta": np.array([p.theta[0] for p in poses])}
    columns |= {name: np.array([p.T[0, k] for p in poses]) for k, name in enumerate("xyz")}
    by_pose = journey("pose", columns, settings)
    for now in (0.0, 1.2345, 3.9):
        for other in (by_volts, by_pose):
            np.testing.assert_allclose(other(now).T, by_wheels(now).T, atol=1e-4)
            np.testing.assert_allclose(other(now).R, by_wheels(now).R, atol=1e-4)


def test_warm_clusters_are_the_cold_ones():
    rng = np.random.default_rng(7)
    points = np.concatenate([rng.normal(c, 0.1, (60, 3)) for c in (0, 3, 7)])
    warm = clusters.segmented(points, 6, None, np.array([[0.2] * 3, [2.8] * 3, [7.1] * 3]))
    cold = clusters.segmented(points, 6, None)
    assert {tuple(np.flatnonzero(warm == k)) for k in range(3)} == {tuple(np.flatnonzero(cold == k)) for k in range(3)}
