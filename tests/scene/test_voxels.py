"""Voxel means, against cells filled one point at a time."""

import numpy as np
import pytest

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.voxels import voxel_means


@pytest.mark.parametrize("voxel", [0.25, 0.02], ids=["many points a cell", "many cells a point"])
def test_voxels_keep_means_and_cells(voxel):
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    means = voxel_means(points, voxel)
    low = points.min(0) - 0.5 * voxel
    cells = {}
    for point in points:
        cells.setdefault(tuple(np.floor((point - low) / voxel).astype(int)), []).append(point)
    np.testing.assert_allclose(means, [np.mean(cells[key], axis=0) for key in sorted(cells)], atol=1e-12)


def test_no_points_have_no_means():
    assert voxel_means(np.empty((0, 3)), 0.1).shape == (0, 3)


def test_a_voxel_too_small_to_number_its_cells_is_refused():
    far = np.array([[0.0, 0.0, 0.0], [900.0, 900.0, 900.0]])
    with pytest.raises(InvalidInputError, match="voxel of 1e-07 m is too small for a cloud that is 900 m"):
        voxel_means(far, 1e-7)
