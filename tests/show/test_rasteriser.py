"""The rasteriser puts things where projection says, in the right order."""

import numpy as np
import pytest

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.shapes import Box, Sphere
from cvqmpt_lab.show.meshes import Viewpoint, joined, rasterise, shape_mesh


def test_rasterised_ball_has_the_right_place_size_and_depth():
    viewpoint, shape = Viewpoint((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0), height_angle=0.6), (240, 320)
    ball = shape_mesh(Sphere(0.3)).placed(pose((0.0, 0.2, 0.1)), (1.0, 1.0, 1.0))
    view = rasterise(ball, viewpoint, shape)
    column, row, depth = viewpoint.screen(np.array([0.0, 0.2, 0.1]), shape)
    assert column < 160 and row < 120  # +y is left, +z is up
    assert [view.columns.mean(), view.rows.mean()] == pytest.approx([column, row], abs=2.0)
    radius = 120 / np.tan(0.3) * 0.3 / np.sqrt(depth**2 - 0.3**2)
    assert len(view.face) == pytest.approx(np.pi * radius**2, rel=0.05)
    assert view.depth.min() == pytest.approx(2.0 - 0.3, abs=0.01)
    ray = viewpoint.rays(view.rows, view.columns, shape)
    points = viewpoint.eye + view.depth[:, None] * ray
    np.testing.assert_allclose(np.linalg.norm(points - [0.0, 0.2, 0.1], axis=1), 0.3, atol=0.01)


def test_nearer_triangle_hides_the_farther_one():
    near, far = (
        shape_mesh(Box((0.1, size, size))).placed(pose((x, 0, 0)), (1.0, 1.0, 1.0))
        for x, size in ((0, 0.5), (1, 4))
    )
    view = rasterise(joined([far, near]), Viewpoint((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0)), (41, 41))
    centre = (view.rows == 20) & (view.columns == 20)
    assert view.depth[centre] == pytest.approx(1.95)
    assert view.depth[(view.rows == 1) & (view.columns == 1)] == pytest.approx(2.95)
