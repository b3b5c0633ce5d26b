"""A whole track adjusted at once: exact sightings of a vehicle that is not flat give its speed and its shape back."""

import numpy as np
import pytest

from visfuse_cli.facing.adjust import RIGHT, SPEED, Rules, Sightings, adjust
from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import in_right, projected
from visfuse_cli.records import Lens, StereoRig

pytestmark = pytest.mark.geometry

K = np.array([[2200.0, 0, 512], [0, 2200, 384], [0, 0, 1]])
RIG = StereoRig(Lens(K, np.zeros(5)), Lens(K, np.zeros(5)), np.eye(3), np.array([-0.5, 0, 0]), None)
WAY = Way(np.array([[2.0, 1.0, 80.0], [1.0, 1.0, 20.0]]))
T = np.arange(16) * 0.2


def sightings(noise, wild=0, aside=0.0):
    """Ten pieces up to half a metre off the plane of the front, 15 m/s, `wild` sightings somewhere else."""
    rng = np.random.default_rng(3)
    pieces = np.column_stack([rng.uniform(-0.5, 0.5, 10), rng.uniform(-0.9, 0.9, 10), rng.uniform(-0.6, 0.6, 10)])
    pieces -= pieces.mean(axis=0)
    states = np.column_stack([15 * T, np.full(16, 15.0), np.full(16, aside), np.zeros(16)])
    point, axes = WAY.frame(states[:, 0])
    places = (point + aside * axes[:, :, 1])[:, None] + pieces @ np.swapaxes(axes, 1, 2)
    left, right = projected(K, places).reshape(-1, 2), projected(K, in_right(RIG, places)).reshape(-1, 2)
    left, right = left + noise * rng.normal(size=left.shape), right + noise * rng.normal(size=right.shape)
    left[rng.permutation(len(left))[:wild]] += 8.0
    cov = np.tile(0.03**2 * np.eye(2), (160, 1, 1))
    frame, piece = np.repeat(np.arange(16), 10), np.tile(np.arange(10), 16)
    anchor = projected(K, point[0] + aside * axes[0][:, 1])
    return Sightings(T, frame, piece, left, right, cov, cov), states, pieces, anchor


def adjusted(seen, start, anchor):
    rules = Rules(lateral=0.1, vertical=0.03, sigma_v=0.06, relief=0.1, height=1.2, anchor=anchor)
    rough = start + np.array([0.8, 1.5, 0.2, 0.1])
    return adjust(RIG, WAY, seen, rules, None, rough)


def test_exact_sightings_give_speed_and_shape_back():
    seen, states, pieces, anchor = sightings(0.0)
    found = adjusted(seen, states, anchor)
    np.testing.assert_allclose(found.states[:, SPEED], 15.0, atol=0.02)
    np.testing.assert_allclose(found.pieces - found.pieces.mean(axis=0), pieces, atol=0.03)


def test_the_deviation_is_that_of_the_error_and_wild_sightings_do_not_pull():
    seen, states, _, anchor = sightings(0.05, wild=12)
    found = adjusted(seen, states, anchor)
    off = found.states[:, SPEED] - 15.0
    sigma = np.sqrt(np.diag(found.cov)[SPEED::4])
    assert np.all(np.abs(off) < 4 * sigma)
    assert np.abs(off).mean() < 0.1


def test_drift_beside_the_way_is_told():
    seen, states, _, anchor = sightings(0.02, aside=0.7)
    np.testing.assert_allclose(adjusted(seen, states, anchor).states[:, RIGHT], 0.7, atol=0.05)
