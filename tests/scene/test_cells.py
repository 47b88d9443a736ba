"""Cells of clouds and maps: each once, joined to boxes that are those cells and no more."""

import numpy as np
import pytest

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.cells import cells_of, distinct, merged
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.shapes import OccupancyMap, PointCloud


def filled(boxes):
    """Every cell of boxes, sorted (k, 3)."""
    cells = [low + np.argwhere(np.ones(high - low, dtype=bool)) for low, high in zip(*boxes, strict=True)]
    return np.concatenate(cells)


@pytest.mark.parametrize("share", [0.05, 0.5, 1.0])
def test_boxes_are_the_cells_and_none_twice(share):
    rng = np.random.default_rng(0)
    index = np.argwhere(rng.random((17, 9, 23)) < share)
    boxes = merged(index)
    assert np.array_equal(distinct(filled(boxes)), index) and len(filled(boxes)) == len(index)
    assert len(boxes.low) == 1 if share == 1.0 else len(boxes.low) < len(index)


def test_cells_hold_the_points_of_a_cloud_wherever_its_origin_lies():
    rng, radius = np.random.default_rng(1), 0.01
    points = rng.uniform(-1.0, 1.0, (3000, 3))
    T = pose((0.3, -0.2, 0.1), 0.7)
    for shift in (0.0, 1e4):
        T_shifted = T @ pose((-shift, 0.0, 0.0))
        cells = cells_of(PointCloud(points + (shift, 0.0, 0.0), radius), T_shifted)
        world = points @ T[:3, :3].T + T[:3, 3]
        inside = (world - cells.T_parent_cells[:3, 3]) @ cells.T_parent_cells[:3, :3] / cells.edge
        assert cells.edge == 2.0 * radius and np.array_equal(
            distinct(np.floor(inside).astype(int)), cells.index
        )


def test_cells_of_a_map_are_those_in_reach():
    cells = np.array([[0, 0, 0], [9, 0, 0], [10, 0, 0], [10, 0, 0], [-50, 3, 2]], dtype=float)
    found = cells_of(OccupancyMap(cells, 0.1, 0.05), pose((0.0, 0.0, 0.5)), reach=1.0)
    assert found.padding == 0.05 and found.index.tolist() == [[0, 0, 0], [9, 0, 0]]
    assert cells_of(OccupancyMap(cells, 0.1), pose((0.0, 0.0, 9.0)), reach=0.9) is None


def test_a_map_is_not_carried():
    with pytest.raises(InvalidInputError, match="'bag' is an occupancy map; what is carried is a solid"):
        Attachment("bag", OccupancyMap(np.zeros((1, 3))), np.eye(4))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"cells": [[0.5, 0, 0]]}, "holds 0.5; give whole numbers"),
        ({"cells": [[10_000_000, 0, 0]]}, "whole numbers from -1000000"),
        ({"cells": []}, r"must be \(any, 3\)"),
        ({"cells": np.empty((0, 3))}, "is empty"),
        ({"cells": [[0, 0, 0]], "resolution": 1e-5}, "give 0.001 m or more"),
        ({"cells": [[0, 0, 0]], "padding": -0.01}, "0 or more"),
    ],
    ids=str,
)
def test_maps_that_are_none_are_refused(fields, message):
    with pytest.raises(InvalidInputError, match=message):
        OccupancyMap(**fields)
