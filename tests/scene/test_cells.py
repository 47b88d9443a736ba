"""Boxes of clouds and maps: they cover every ball and cell, and little more."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.cells import CELL, blocks_of, cells_with, distinct, merged
from cvqmpt_lab.scene.shapes import OccupancyMap, PointCloud


def filled(boxes):
    """Every cell of boxes, sorted (k, 3)."""
    corners = zip(boxes.low, boxes.high, strict=True)
    cells = [low + np.argwhere(np.ones(high - low, dtype=bool)) for low, high in corners]
    return np.concatenate(cells)


@pytest.mark.parametrize("share", [0.05, 0.5, 1.0])
def test_boxes_are_the_cells_and_none_twice(share):
    rng = np.random.default_rng(0)
    index = np.argwhere(rng.random((17, 9, 23)) < share)
    cells = cells_with(0.3 * index[rng.permutation(len(index))].T, 0.3)
    boxes = merged(cells)
    assert np.array_equal(distinct(filled(boxes)), index) and len(filled(boxes)) == len(index)
    np.testing.assert_allclose(boxes.least, 0.3 * boxes.low)
    np.testing.assert_allclose(boxes.most, 0.3 * (boxes.high - 1))
    assert len(boxes.low) == 1 if share == 1.0 else len(boxes.low) < len(index)


@pytest.mark.parametrize("radius", [1e-6, 0.01, 0.05])
@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_boxes_hold_the_balls_of_a_cloud_and_little_more(shift, radius):
    rng = np.random.default_rng(1)
    points = rng.uniform(-1.0, 1.0, (3000, 3)) + (shift, 0.0, 0.0)
    blocks = blocks_of(PointCloud(points, radius), pose((-shift, 0.0, 0.0)))
    assert blocks.padding == radius and len(blocks.low) <= len(points)
    above, below = points[:, None] >= blocks.low, points[:, None] <= blocks.high
    assert (above & below).all(axis=2).any(axis=1).all()
    probes = blocks.low + rng.random(blocks.low.shape) * (blocks.high - blocks.low)
    edge = max(CELL * radius, 2.0 / 60_000)
    assert cKDTree(points).query(probes)[0].max() < np.sqrt(3.0) * edge


def test_boxes_of_a_map_are_its_cells_in_reach():
    cells = np.array([[0, 0, 0], [9, 0, 0], [10, 0, 0], [10, 0, 0], [-50, 3, 2]], dtype=float)
    low, high, padding = blocks_of(OccupancyMap(cells, 0.1, 0.05), pose((0.0, 0.0, 0.5)), reach=1.0)
    assert padding == 0.05
    np.testing.assert_allclose(
        [low, high], [[[0, 0, 0], [0.9, 0, 0]], [[0.1, 0.1, 0.1], [1.0, 0.1, 0.1]]]
    )
    assert len(blocks_of(OccupancyMap(cells, 0.1), pose((0.0, 0.0, 9.0)), reach=0.9).low) == 0


def test_a_map_with_many_cells_across_is_held_by_larger_ones():
    cells = np.random.default_rng(2).integers(0, 2 * 60_000, (3000, 3)).astype(float)
    low, high, _ = blocks_of(OccupancyMap(cells, 0.1), np.eye(4))
    for corner in (0.1 * cells + 1e-6, 0.1 * cells + 0.1 - 1e-6):
        assert ((corner[:, None] > low) & (corner[:, None] < high)).all(axis=2).any(axis=1).all()
