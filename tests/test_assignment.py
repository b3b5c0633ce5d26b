"""Assignment against brute force, and where cells or whole matrices are missing."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from visfuse_cli.maths import assignment
from visfuse_cli.records import Gaussian

COSTS = st.one_of(st.just(np.inf), st.just(np.nan), st.floats(-100, 100))


def brute_force(cost: np.ndarray) -> tuple[int, float]:
    """Most pairs, then least cost, over all one-to-one assignments."""
    if cost.shape[0] > cost.shape[1]:
        cost = cost.T
    best = (0, 0.0)
    for columns in permutations(range(cost.shape[1]), cost.shape[0]):
        values = cost[range(cost.shape[0]), list(columns)]
        finite = values[np.isfinite(values)]
        best = min(best, (-len(finite), float(finite.sum())))
    return best


@settings(max_examples=150, deadline=None)
@given(st.integers(1, 4), st.integers(1, 4), st.data())
def test_as_many_pairs_as_possible_at_the_least_cost(n: int, m: int, data: st.DataObject):
    cost = np.array(data.draw(st.lists(COSTS, min_size=n * m, max_size=n * m))).reshape(n, m)
    pairs, rows, columns = assignment.assign(cost)
    count, total = brute_force(cost)
    assert len(pairs) == -count
    assert cost[pairs[:, 0], pairs[:, 1]].sum() == pytest.approx(total, abs=1e-9)
    assert sorted([*pairs[:, 0], *rows]) == list(range(n))
    assert sorted([*pairs[:, 1], *columns]) == list(range(m))


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (2, 0)])
def test_empty_matrices_leave_everything_unmatched(shape: tuple[int, int]):
    pairs, rows, columns = assignment.assign(np.zeros(shape))
    assert pairs.shape == (0, 2)
    assert (len(rows), len(columns)) == shape


def test_costs_at_or_above_the_forbidden_one_are_not_matched():
    pairs, rows, columns = assignment.assign(np.array([[1.0, 9.0], [9.0, 9.5]]), forbidden=9.0)
    np.testing.assert_array_equal(pairs, [[0, 0]])
    assert (list(rows), list(columns)) == ([1], [1])


def test_the_gate_passes_true_pairs_with_its_probability():
    rng = np.random.default_rng(1)
    squared = np.sum(rng.normal(size=(100_000, 3)) ** 2, axis=1)
    assert np.isfinite(assignment.gate(squared, 3, 0.99)).mean() == pytest.approx(0.99, abs=0.002)


def test_distances_wrap_angles_and_add_both_covariances():
    expected = Gaussian(np.array([[0.0, 3.1], [5.0, 0.0]]), np.stack([np.diag([1.0, 0.01])] * 2))
    measured = Gaussian(np.array([[2.0, -3.1]]), np.diag([3.0, 0.03])[None])
    squared = assignment.distances(expected, measured, angles=(1,))
    assert squared.shape == (2, 1)
    assert squared[0, 0] == pytest.approx(4 / 4 + (2 * np.pi - 6.2) ** 2 / 0.04)


def test_distances_without_tracks_are_empty():
    nothing = Gaussian(np.zeros((0, 2)), np.zeros((0, 2, 2)))
    assert assignment.distances(nothing, Gaussian(np.zeros((3, 2)), np.zeros((3, 2, 2)))).shape == (0, 3)
