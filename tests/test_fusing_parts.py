"""Parts of `fuse-cameras`: shadows told from people, bodies learnt, a motion that holds, sets that go on."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from tests.test_fusion import ring
from visfuse_cli.fusing.audit import Finding, complaints, misfits
from visfuse_cli.fusing.body import usual_body
from visfuse_cli.maths import motion, multiview
from visfuse_cli.pipeline import Run
from visfuse_cli.records import Frame
from visfuse_cli.vision.background import FOREGROUND, SHADOW
from visfuse_cli.vision.ground_shadows import GroundShadows

SIZES = np.tile([[640, 480]], (4, 1))


def dark(P: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Labels (480, 640) with what covers points (n, 3) m dark."""
    labels = np.zeros((480, 640), np.uint8)
    pixels, _ = multiview.project(P, points)
    for u, v in np.rint(pixels).astype(int):
        labels[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3] = SHADOW
    return labels


def test_a_grey_person_is_no_shadow_and_a_shadow_is():
    P = ring(high=6.0)  # from there all see the ground behind the person
    x, y = np.meshgrid(np.arange(-3, 3.1, 0.5), np.arange(-3, 3.1, 0.5))
    shadows = GroundShadows(P, SIZES, np.column_stack([x.ravel(), y.ravel()]))
    angle, up = np.meshgrid(np.linspace(0, 2 * np.pi, 24), np.arange(0.02, 1.75, 0.04))
    body = np.column_stack([0.15 * np.cos(angle.ravel()), 0.15 * np.sin(angle.ravel()), up.ravel()])
    along, aside = np.meshgrid(np.arange(0.5, 2.0, 0.04), np.arange(-0.15, 0.16, 0.04))
    cast = np.column_stack([along.ravel(), aside.ravel(), 0 * along.ravel()])
    labels = {c: np.maximum(dark(P[c], body), dark(P[c], cast)) for c in range(4)}
    settled = shadows.settle(labels)
    whole = 0
    for c in range(4):
        chest, _ = multiview.project(P[c], body[body[:, 2] > 0.6])
        floor, _ = multiview.project(P[c], cast[cast[:, 0] > 1.0])
        hidden = dark(P[c], body)  # where the body stands before its shadow
        found = [settled[c][v, u] for u, v in np.rint(chest).astype(int)]
        left = [settled[c][v, u] for u, v in np.rint(floor).astype(int) if not hidden[v, u]]
        whole += np.mean(np.array(found) == FOREGROUND) > 0.9
        assert np.mean(np.array(left) == SHADOW) > 0.9
    assert whole >= 3  # the fourth sees the person before the shadow, which the others see on the ground behind
    assert all((labels[c] == FOREGROUND).sum() == 0 for c in range(4))  # what was given is not changed


def test_a_reflection_that_one_camera_sees_is_left_dark():
    P = ring()
    x, y = np.meshgrid(np.arange(-3, 3.1, 0.5), np.arange(-3, 3.1, 0.5))
    shadows = GroundShadows(P, SIZES, np.column_stack([x.ravel(), y.ravel()]))
    blank = np.zeros((480, 640), np.uint8)
    labels = {c: blank.copy() for c in range(4)}
    labels[0][300:340, 300:340] = SHADOW
    assert not np.any(shadows.settle(labels)[0] == FOREGROUND)


def test_height_is_learnt_from_heads_over_the_ground_whatever_feet_and_heads_are_like():
    body = usual_body(1.72, 0.12, 0.55, 12.0)
    rng = np.random.default_rng(3)
    for _ in range(300):
        slope = rng.uniform(0.2, 0.8)
        body.ends.learn(1.6 + slope * 0.07 + rng.normal(0, 0.02), np.array([1.0, slope, 0.0]), 0.08)
        body.ends.learn(slope * 0.12 + rng.normal(0, 0.02), np.array([0.0, 0.0, slope]), 0.08)
    np.testing.assert_allclose(body.ends.mean, [1.6, 0.07, 0.12], atol=0.03)
    assert 0 < body.ends.cov[0, 0] < 0.02**2


def test_a_held_acceleration_splits_and_is_white_from_afar():
    (F1, Q1), (F2, Q2) = motion.held_acceleration(0.3, 0.4), motion.held_acceleration(0.7, 0.4)
    F, Q = motion.held_acceleration(1.0, 0.4)
    np.testing.assert_allclose(F2 @ F1, F, atol=1e-12)
    np.testing.assert_allclose(F2 @ Q1 @ F2.T + Q2, Q, atol=1e-12)
    _, far = motion.held_acceleration(200.0, 0.4)
    white = motion.constant_velocity_noise(200.0, 1.0, 1)
    np.testing.assert_allclose(far[:2, :2], white, rtol=0.01)


@dataclass
class Stamps:
    """Footage that is time stamps alone."""

    camera: str
    t: list[float]
    frame_count: int | None = field(init=False)

    def __post_init__(self) -> None:
        self.frame_count = len(self.t)

    def frames(self) -> Iterator[Frame]:
        for index, t in enumerate(self.t):
            yield Frame(self.camera, index, t, np.zeros((1, 1, 3), np.uint8))


@pytest.mark.parametrize(
    ("first", "numbers"),
    [
        ([0.0, 0.1, 0.2], [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]),  # it ends: counting goes on
        ([0.0, 0.1, 0.2, 0.8, 0.9], [0, 1, 2, -1, -1, -1, -1, -1, 3, 4]),  # a gap has no frames to count
    ],
)
def test_sets_go_on_without_the_first_camera(first, numbers):
    sources = {"a": Stamps("a", first), "b": Stamps("b", [0.1 * k for k in range(10)])}
    with Run() as run:
        sets = list(run.synchronise(sources, 0.055, None, 0.1))
        alone = list(run.synchronise({"a": Stamps("a", first), "b": sources["b"]}, 0.055))
    assert [each.index for each in sets] == numbers
    assert [each.frames["b"].index for each in sets] == list(range(10))
    np.testing.assert_allclose([each.t for each in sets], 0.1 * np.arange(10), atol=1e-9)
    assert [each.index for each in alone] == list(range(len(first)))


def test_a_camera_that_stands_elsewhere_is_no_witness_of_clocks():
    def found(shift_m: float = 0.02, late: float = 0.0, unused: float = 0.1) -> Finding:
        return Finding(200, np.array([50.0, 0.0]) * shift_m, shift_m, late, 0.005, unused)

    names = ["a", "b", "c", "d"]
    said = complaints(names, [found(), found(late=0.3), found(), found()], 0.05)
    assert len(said) == 1
    assert "'b' is about 0.30 s or more late" in said[0]
    said = complaints(names, [found(), found(), found(0.6, 0.2, 0.9), found()], 0.05)
    assert len(said) == 1
    assert "'c' does not fit the others" in said[0]
    # with one witness left nobody is called late
    assert len(complaints(names[:3], [found(late=0.3), found(), found(0.6, 0.0, 0.9)], 0.05)) == 1
    assert misfits([found(), found(0.6, 0.0, 0.9)]) == []  # of two, either may be the one
