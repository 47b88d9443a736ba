"""Meshes are as large as what they show, closed, and stand where the robot stands."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from cvqmpt_lab.scene.shapes import Box, bounding_radius, shape_vertices
from cvqmpt_lab.show.meshes import hull_mesh, poses_along, shape_mesh


def test_meshes_are_as_large_as_their_shapes(every_shape):
    for shape in every_shape:
        farthest = np.linalg.norm(shape_mesh(shape).corners, axis=-1).max()
        assert farthest == pytest.approx(bounding_radius(shape), rel=0.01), shape


def test_poses_along_are_the_robots(panda):
    states = panda.random_configurations(np.random.default_rng(1), 4)
    for q, T_world_hand in zip(states, poses_along(panda, states)[1], strict=True):
        np.testing.assert_allclose(T_world_hand, panda.pose(q), atol=1e-9)


def test_hull_mesh_is_closed_and_faces_outwards():
    points = np.random.default_rng(2).normal(size=(60, 3))
    corners = hull_mesh(points).corners
    volume = np.linalg.det(corners).sum() / 6.0
    assert volume == pytest.approx(ConvexHull(points).volume)
    box = hull_mesh(shape_vertices(Box((1.0, 2.0, 3.0))))
    assert np.linalg.det(box.corners).sum() / 6.0 == pytest.approx(6.0)
    np.testing.assert_allclose(np.abs(box.normals).max(axis=-1), 1.0)
