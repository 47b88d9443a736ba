"""Viewpoints hold what moves in the picture, and look from where nothing stands before it."""

import numpy as np
import pytest

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.shapes import Box, Sphere
from cvqmpt_lab.show.meshes import shape_mesh
from cvqmpt_lab.show.stage import AZIMUTHS, clear_viewpoint, framed

SIZE = (300, 200)
WHITE = (1.0, 1.0, 1.0)


@pytest.mark.parametrize("azimuth", AZIMUTHS[:4])
def test_all_points_are_in_the_picture(azimuth):
    points = np.random.default_rng(0).normal(size=(50, 3)) * (1.0, 0.3, 2.0)
    column, row, depth = np.moveaxis(framed(points, azimuth, SIZE).screen(points, SIZE[::-1]), -1, 0)
    assert (depth > 0).all()
    assert (column > 0).all() and (column < SIZE[0]).all() and (row > 0).all() and (row < SIZE[1]).all()
    assert max(np.ptp(column) / SIZE[0], np.ptp(row) / SIZE[1]) > 0.5


def test_a_wall_is_looked_past():
    ball = shape_mesh(Sphere(0.3))
    usual = clear_viewpoint([ball], [], SIZE)
    towards = np.subtract(usual.eye, usual.target)
    yaw = np.arctan2(towards[1], towards[0])
    wall = shape_mesh(Box((0.05, 0.7, 0.7))).placed(pose(0.5 * towards, yaw), WHITE)
    other = clear_viewpoint([ball], [wall], SIZE)
    assert np.dot(np.subtract(other.eye, other.target)[:2], towards[:2]) < 0.8 * np.dot(
        towards[:2], towards[:2]
    )
