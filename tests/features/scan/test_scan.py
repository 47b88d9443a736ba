"""A scan becomes a cloud of the obstacles: merged, filtered, without the arm (and the table)."""

from dataclasses import replace

import coal
import numpy as np
import pinocchio as pin
import pytest
from refusals import refused
from scipy.spatial import cKDTree

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.features.scan.depth import read_capture
from cvqmpt_lab.features.scan.scan import (
    Arm,
    ScanSettings,
    near_robot,
    outliers,
    refuse_touching,
    scan,
)
from cvqmpt_lab.robot.hulls import coal_distance
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.coal_shapes import transform
from cvqmpt_lab.scene.shapes import PointCloud
from cvqmpt_lab.sensing.crop import voxel_means


@pytest.fixture
def capture(files):
    return read_capture(files.depth, files.intrinsics, files.extrinsics)


def cleaned(capture, arm=None, **settings):
    return scan([capture], ScanSettings(**settings), np.random.default_rng(0), arm)


def test_the_arm_in_the_depth_image_is_not_an_obstacle(files, capture):
    arm = Arm(files.robot, files.q)
    with_arm, made = cleaned(capture), cleaned(capture, arm)
    assert near_robot(with_arm.points, *arm, 0.05).sum() > 100
    assert not near_robot(made.points, *arm, 0.05).any()
    assert CollisionChecker(files.robot, with_arm.scene()).in_collision(files.q)
    assert not CollisionChecker(files.robot, made.scene()).in_collision(files.q)
    refuse_touching(made.scene(), arm)
    message = r"is inside the scan: panda_\w+ and scan overlap"
    refused(message, refuse_touching, with_arm.scene(), arm)


def test_captures_are_merged_at_the_poses_of_their_cameras(capture):
    half = len(capture.points) // 2
    halves = capture.points[:half], capture.points[half:]
    parts = [replace(capture, points=points) for points in halves]
    settings = ScanSettings(neighbours=0)
    both = scan(parts, settings, np.random.default_rng(0))
    np.testing.assert_allclose(both.points, cleaned(capture, neighbours=0).points, atol=1e-9)
    assert both.dropped == 2 * capture.dropped


def test_a_scan_without_a_pose_is_levelled_by_its_table(files, capture):
    made = cleaned(replace(capture, T_world_camera=np.eye(4)), level=True, front=(0.3, 0.0, 0.0))
    T, _ = made.levelled
    tilt = np.degrees(np.arccos(T[2, :3] @ capture.T_world_camera[2, :3]))
    assert tilt < 0.5, "vertical as with the camera's true pose"
    top = made.points[np.abs(made.points[:, 2]) < 0.01]
    assert len(top) > 0.4 * len(made.points)
    assert T[2, 3] == pytest.approx(capture.T_world_camera[2, 3], abs=0.005)  # the camera's height


@pytest.mark.parametrize("plane", ["box", "remove"])
def test_the_table_becomes_a_box_or_is_removed(files, capture, plane):
    arm = Arm(files.robot, files.q)
    made, kept = cleaned(capture, arm, plane=plane), cleaned(capture, arm)
    assert made.steps[-1].name == "supporting plane" and len(made.points) < 0.6 * len(kept.points)
    assert abs(made.plane.normal @ (0.6, 0.0, 0.0) - made.plane.offset) < 0.005
    crate = (np.abs(made.points - (0.6, 0.3, 0.1)) < (0.1, 0.1, 0.11)).all(axis=1)
    assert crate.sum() > 100, "objects on the table stay"
    assert (made.table is not None) == (plane == "box")
    if made.table is not None:
        assert set(made.scene().names) == {"table", "scan"}
        np.testing.assert_allclose(made.table.T_world_object[2, 3], 0.0, atol=0.005)


def test_obstacles_cover_the_surface_that_the_camera_saw(capture):
    made = cleaned(capture, neighbours=0)
    cells = made.scene()["scan"].shape
    # in an occupied cell or next to one
    assert nearest(capture.in_world[::50], cells.centres).max() <= 0.02
    assert len(cells.cells) < len(made.points)
    balls = PointCloud(made.points, 0.87 * 0.01)
    assert made.scene(balls)["scan"].shape is balls
    assert nearest(capture.in_world[::50], balls.points).max() <= balls.radius


def nearest(points, others):
    return cKDTree(others).query(points)[0]


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
    """Return the distance [m] of a point from all pieces of the robot at q, by coal."""
    data, geometry = robot.model.createData(), robot.collision_model
    placed = pin.GeometryData(geometry)
    pin.updateGeometryPlacements(robot.model, data, geometry, placed, q)
    dot, here = coal.Sphere(1e-9), transform(pose(point))
    pairs = zip(geometry.geometryObjects, placed.oMg, strict=True)
    return min(coal_distance(x.geometry, transform(T.homogeneous), dot, here) for x, T in pairs)


def test_outliers_are_those_with_few_neighbours():
    points = np.random.default_rng(2).uniform(0, 1, (400, 3))
    counts = (np.linalg.norm(points[:, None] - points, axis=2) <= 0.1).sum(axis=1) - 1
    np.testing.assert_array_equal(outliers(points, 0.1, 2), counts < 2)
    assert 0 < (counts < 2).sum() < len(points)
    assert outliers(points[:2], 1.0, 2).all(), "fewer points than neighbours"


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
