"""Boxes of clouds and maps contain every ball and cell, with little free space."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.scene.cells import CELL_EDGE_RADII, blocks_of
from cvqmpt_lab.scene.shapes import OccupancyMap, PointCloud


@pytest.mark.parametrize("radius", [1e-6, 0.01, 0.05])
@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_boxes_contain_the_balls_of_a_cloud_and_little_free_space(shift, radius):
    rng = np.random.default_rng(1)
    points = rng.uniform(-1.0, 1.0, (3000, 3)) + (shift, 0.0, 0.0)
    blocks = blocks_of(PointCloud(points, radius), pose((-shift, 0.0, 0.0)))
    assert blocks.padding == radius and len(blocks.low) <= len(points)
    above, below = points[:, None] >= blocks.low, points[:, None] <= blocks.high
    assert (above & below).all(axis=2).any(axis=1).all()
    probes = blocks.low + rng.random(blocks.low.shape) * (blocks.high - blocks.low)
    edge = max(CELL_EDGE_RADII * radius, 2.0 / 60_000)
    assert cKDTree(points).query(probes)[0].max() < np.sqrt(3.0) * edge


def test_a_map_of_very_many_cells_is_contained_in_larger_ones():
    cells = np.random.default_rng(2).integers(0, 2 * 60_000, (3000, 3)).astype(float)
    low, high, _ = blocks_of(OccupancyMap(cells, 0.1), np.eye(4))
    for corner in (0.1 * cells + 1e-6, 0.1 * cells + 0.1 - 1e-6):
        assert ((corner[:, None] > low) & (corner[:, None] < high)).all(axis=2).any(axis=1).all()
