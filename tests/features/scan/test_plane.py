"""The table is found in tilted scans and levelled in front of the robot."""

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from cvqmpt_lab.features.scan.plane import (
    box_around,
    level_pose,
    on_table,
    supporting_plane,
    table_below,
)

FRONT = (0.4, 0.1, -0.05)


def table(rng, count=6000):
    """Points (m, 3) of a table of 0.8 x 1 m from the origin on, with boxes, a wall and noise."""
    top = rng.uniform((0.0, -0.5, 0.0), (0.8, 0.5, 0.0), (count, 3))
    top[:, 2] = 0.002 * rng.standard_normal(count)
    boxes = rng.uniform((0.3, -0.1, 0.0), (0.5, 0.2, 0.15), (count // 4, 3))
    wall = rng.uniform((1.6, -1.0, -0.5), (1.6, 1.0, 1.0), (count // 2, 3))
    return np.concatenate([top, boxes, wall])


def camera_pose(pitch, roll=0.0):
    """T_world_camera of a camera in front of the table, along x and `pitch` [deg] down."""
    T = np.eye(4)
    ahead_right = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])  # columns: right, down, ahead
    T[:3, :3] = Rotation.from_euler("y", pitch, degrees=True).as_matrix() @ ahead_right
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    T[:3, 3] = (-0.3, 0.05, 0.8)
    return T


@pytest.mark.parametrize(("pitch", "roll"), [(15, 0), (45, 10), (70, -20), (88, 5)])
def test_a_tilted_scan_is_levelled(pitch, roll):
    rng = np.random.default_rng(pitch)
    world, T = table(rng), camera_pose(pitch, roll)
    seen = (world - T[:3, 3]) @ T[:3, :3]
    plane = table_below(seen, np.radians(pitch), 1.0, rng)
    assert plane.residual < 0.004 and plane.offset == pytest.approx(-0.8, abs=0.003)
    assert np.degrees(np.arccos(plane.normal @ (T[:3, :3].T @ (0, 0, 1)))) < 0.3
    level = level_pose(seen, plane, FRONT)
    np.testing.assert_allclose(level[:3, :3] @ level[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(level[:3, :3]) > 0
    back = (seen @ level[:3, :3].T + level[:3, 3])[:6000]
    assert abs(np.median(back[:, 2]) - FRONT[2]) < 0.003 and np.std(back[:, 2]) < 0.005
    assert back[:, 0].min() == pytest.approx(FRONT[0], abs=0.1)
    if roll == 0:
        np.testing.assert_allclose(back, world[:6000] + FRONT, atol=0.03)


def test_the_box_contains_the_points_of_the_plane():
    rng = np.random.default_rng(0)
    points = table(rng) + (0.4, 0.1, 0.2)
    plane = supporting_plane(points, np.array([0, 0, 1.0]), 0.2, rng)
    held = points[on_table(points, plane)]
    box = box_around(held, plane)
    local = (held - box.T_world_object[:3, 3]) @ box.T_world_object[:3, :3]
    assert (np.abs(local) <= 0.5 * np.array(box.shape.size) + 1e-9).all()
    np.testing.assert_allclose(box.T_world_object[:3, 3], (0.8, 0.1, 0.2), atol=0.01)
    np.testing.assert_allclose(box.shape.size[:2], (0.8, 1.0), atol=0.03)


SCATTERED = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
WALL = SCATTERED * (0, 1, 1)


@pytest.mark.parametrize("points", [SCATTERED, np.zeros((1, 3)), np.zeros((50, 3)), WALL])
def test_a_cloud_without_a_table_is_refused(points):
    up, rng = np.array([0, 0, 1.0]), np.random.default_rng(0)
    refused("no supporting plane", supporting_plane, points, up, 0.2, rng)


def office(rng, height):
    """Points (m, 3) of a wall 5 m ahead, and of a floor `height` [m] below the optical frame."""
    wall = rng.uniform((-3.0, -1.5, 5.05), (3.0, 1.5, 5.05), (6000, 3))
    floor = rng.uniform((-2.0, height, 1.0), (2.0, height, 5.0), (2000, 3))
    return np.concatenate([wall, floor])


@pytest.mark.parametrize(
    ("points", "down", "words"),
    [
        (lambda rng: office(rng, 1.6), 20.0, "1.60 m above .* of 25% .* at most 1.20 m"),
        (lambda rng: office(rng, -1.1), 20.0, "the camera is -1.10 m above"),
        (lambda rng: office(rng, 1.1)[:6000], 20.0, "largest plane, of 100% .* 70 deg off level"),
        (lambda rng: office(rng, 1.1)[:6000] * (1, 1, 0.2), 40.0, "50 deg off level"),
        (lambda rng: office(rng, 1.1), -1.0, "a camera that looks -1 deg down"),
    ],
)
def test_no_wall_ceiling_or_far_floor_is_taken_for_a_table(points, down, words):
    rng = np.random.default_rng(0)
    refused(words, table_below, points(rng), np.radians(down), 1.2, rng)


def test_a_level_plane_is_found_before_a_larger_wall():
    rng = np.random.default_rng(0)
    plane = table_below(office(rng, 1.1), np.radians(20.0), 1.2, rng)
    np.testing.assert_allclose(plane.normal, (0.0, -1.0, 0.0), atol=1e-3)
    assert plane.offset == pytest.approx(-1.1, abs=0.001)
    assert plane.share == pytest.approx(0.25, abs=0.01)
