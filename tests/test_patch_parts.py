"""The parts of a patch: where their cells lie, and that a patch is told by any number of them."""

import cv2
import numpy as np
import pytest

from visfuse_cli.vision import patches


@pytest.mark.parametrize("parts", [4, 7, 10, 13, 16])
def test_the_cells_of_the_parts_fill_two_rows_of_the_square(parts):
    cells = patches.part_cells(parts)
    assert len(cells) == 16 * parts
    upper, lower = cells[cells[:, 1] < 0.5], cells[cells[:, 1] > 0.5]
    assert (len(upper), len(lower)) == (16 * (parts - parts // 2), 16 * (parts // 2))
    for row, middle in ((upper, 0.25), (lower, 0.75)):
        np.testing.assert_allclose(row.mean(axis=0), [0.5, middle])
        assert len(np.unique(row, axis=0)) == len(row)


@pytest.mark.parametrize("parts", [4, 7, 16])
def test_the_pose_that_shows_the_patch_is_the_nearest(parts):
    rng = np.random.default_rng(3)
    picture = cv2.GaussianBlur(rng.integers(0, 255, (200, 240, 3), np.uint8), (0, 0), 3)
    levels = patches.pyramid(picture)
    quad = np.array([[80.0, 60], [160, 60], [160, 120], [80, 120]])
    reference = patches.part_values(levels, quad[None], parts)[0]
    shifts = np.arange(-12.0, 13.0, 3.0)
    moved = quad + np.column_stack([shifts, np.zeros_like(shifts)])[:, None]
    distance = patches.part_distance(patches.part_values(levels, moved, parts), reference)
    assert shifts[distance.argmin()] == 0
    assert distance.min() < 1e-6 < 0.1 < np.delete(distance, distance.argmin()).min()
