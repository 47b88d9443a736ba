"""Filters remove the robot and outliers, and nothing else."""

import coal
import numpy as np
import pinocchio as pin
import pytest

from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.sensing.filters import near_robot, outliers, voxel_means

MARGIN = 0.03


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_points_near_the_robot_are_found_as_coal_measures_them(name):
    robot, rng = robot_from_source({"name": name}), np.random.default_rng(0)
    q = robot.random_configurations(rng, 1)[0]
    points = robot.pose(q)[:3, 3] * rng.uniform(0, 1, (1500, 1)) + rng.uniform(-0.2, 0.2, (1500, 3))
    near = near_robot(points, robot, q, MARGIN)
    distances = np.array([distance_to(robot, q, point) for point in points])
    assert near[distances < MARGIN - 1e-4].all() and (distances < MARGIN).sum() > 20
    # corners reach no farther than those of a cube
    assert not near[distances > np.sqrt(3) * MARGIN].any()
    assert near.sum() < 1.5 * (distances < MARGIN).sum()


def distance_to(robot, q, point):
    """Of a point from the moving and fixed pieces of the robot at q, by coal [m]."""
    data, geometry = robot.model.createData(), robot.collision_model
    placed = pin.GeometryData(geometry)
    pin.updateGeometryPlacements(robot.model, data, geometry, placed, q)
    here = coal.Transform3s(np.eye(3), point)
    dot, request = coal.Sphere(1e-9), coal.DistanceRequest()
    places = [coal.Transform3s(T.rotation, T.translation) for T in placed.oMg]
    return min(
        coal.distance(item.geometry, T, dot, here, request, coal.DistanceResult())
        for item, T in zip(geometry.geometryObjects, places, strict=True)
    )


def test_outliers_are_those_with_few_neighbours():
    points = np.random.default_rng(2).uniform(0, 1, (400, 3))
    counts = (np.linalg.norm(points[:, None] - points, axis=2) <= 0.1).sum(axis=1) - 1
    np.testing.assert_array_equal(outliers(points, 0.1, 2), counts < 2)
    assert 0 < (counts < 2).sum() < len(points)
    assert outliers(points[:2], 1.0, 2).all(), "fewer points than neighbours asked for"


@pytest.mark.parametrize("voxel", [0.25, 0.02])
def test_voxels_keep_means_and_cells(voxel):
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    means = voxel_means(points, voxel)
    low = points.min(0) - 0.5 * voxel
    cells = {}
    for point in points:
        cells.setdefault(tuple(np.floor((point - low) / voxel).astype(int)), []).append(point)
    expected = [np.mean(cells[key], axis=0) for key in sorted(cells)]
    np.testing.assert_allclose(means, expected, atol=1e-12)
