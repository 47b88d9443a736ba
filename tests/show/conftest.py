"""Fixtures of the tests of pictures and recordings."""

import numpy as np
import pytest

from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, OccupancyMap, PointCloud, Sphere
from cvqmpt_lab.search.result import Budget

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


@pytest.fixture(scope="session")
def every_shape():
    """One of each kind."""
    return (
        Box((0.1, 0.2, 0.3)),
        Cylinder(0.1, 0.3),
        Sphere(0.2),
        ConvexMesh(CORNERS),
        PointCloud(CORNERS, 0.05),
        OccupancyMap(CORNERS, 0.1),
    )


@pytest.fixture(scope="package")
def unsolved(problem):
    """Result of `problem` with too little time."""
    return solve(problem, "birrt", Budget(iterations=1), seed=0)
