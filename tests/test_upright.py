"""Pictures made upright, and outlines that several cameras back."""

import cv2
import numpy as np
import pytest

from samples.people import looking_at
from tests.test_fusion import ring
from visfuse_cli.maths import multiview
from visfuse_cli.records import Lens, View
from visfuse_cli.vision.backing import backed, covered
from visfuse_cli.vision.straighten import Straight

LENS = np.array([-0.2, 0.05, 0.001, -0.0005, 0.0])


def view(roll: float, D: np.ndarray) -> View:
    camera = looking_at(np.array([5.0, -3.0, 2.5]), np.array([0, 0, 0.9]), 420.0, (640, 480), roll)
    return View("cam1", Lens(camera.K, D), camera.size, camera.rotation, -camera.rotation @ camera.centre)


@pytest.mark.parametrize("D", [np.zeros(5), LENS], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("roll", [0.0, 0.05, 0.5, -np.pi / 2, np.pi])
def test_an_upright_picture_and_its_footage_lead_into_each_other(roll, D):
    rolled = view(roll, D)
    straight = Straight(rolled, 100_000)
    points = np.array([[0.0, 0, 0], [0, 0, 1.7], [0.3, -0.2, 0.9]])
    P = straight.K @ np.column_stack([rolled.R, rolled.t])
    pixels, _ = multiview.project(P, points)
    lean = np.arctan2(pixels[1, 0] - pixels[0, 0], pixels[0, 1] - pixels[1, 1])
    assert abs(lean) < 0.15  # whatever the roll: the picture is upright, or it was nearly so
    shown, _ = cv2.projectPoints(points, cv2.Rodrigues(rolled.R)[0], rolled.t, rolled.lens.K, D)
    for point, where in zip(pixels, shown.reshape(-1, 2), strict=True):
        np.testing.assert_allclose(straight.shown(point[None]), [*where, 0, 0], atol=1e-6)
    frame = np.zeros((480, 640, 3), np.uint8)
    u, v = np.rint(shown[2, 0]).astype(int)
    frame[v - 3 : v + 4, u - 3 : u + 4] = 255
    picture = straight.picture(frame)
    assert picture.shape[:2] == straight.outside.shape == straight.size[::-1]
    found = np.argwhere(picture[..., 0] > 127).mean(axis=0)[::-1]
    np.testing.assert_allclose(found, pixels[2], atol=1.0)
    assert not picture[straight.outside > 0].any()


def masks(P: np.ndarray, points: np.ndarray) -> dict[int, np.ndarray]:
    found = {}
    for c, camera in enumerate(P):
        found[c] = np.zeros((480, 640), np.uint8)
        for u, v in np.rint(multiview.project(camera, points)[0]).astype(int):
            found[c][max(v - 3, 0) : v + 4, max(u - 3, 0) : u + 4] = 1
    return found


def test_what_one_camera_alone_sees_beside_somebody_is_nobodys():
    P = ring(high=5.0)
    angle, up = np.meshgrid(np.linspace(0, 2 * np.pi, 24), np.arange(0.05, 1.75, 0.04))
    body = np.column_stack([0.2 * np.cos(angle.ravel()), 0.2 * np.sin(angle.ravel()), up.ravel()])
    seen = masks(P, body)
    blank = {c: np.zeros((480, 640), np.uint8) for c in range(4)}
    toward = -np.linalg.solve(P[0, :, :3], P[0, :, 3])[:2]
    mirrored = np.array([*(0.8 * toward / np.linalg.norm(toward)), 0.0])  # on the ground before the feet
    u, v = np.rint(multiview.project(P[0], mirrored)[0]).astype(int)
    beside = (slice(v - 12, v + 12), slice(u - 12, u + 12))
    person = seen[0].copy()
    seen[0][beside] = 1
    room = backed(P, seen, blank, np.zeros((1, 3)))[0]
    own = covered(room[0], (0, 0, 640, 480))
    assert own[person > 0].all()
    assert np.mean(own[beside][person[beside] == 0]) < 0.3
    seen[1][:], seen[2][:] = 0, 0  # two of three others see nothing at all: nothing is left to be limited by
    assert 0 not in backed(P, seen, blank, np.zeros((1, 3)))[0]
    assert backed(P[:2], {c: seen[c] for c in (0, 1)}, blank, np.zeros((1, 3))) == [{}]  # one other is no judge
