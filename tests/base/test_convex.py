"""Convex polytopes contain what they are made of, and little more."""

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from cvqmpt_lab.base.convex import (
    convex_hull,
    few_vertices_around,
    halves,
    hull_volume,
    polytope_around_ball,
    prism_around,
)


def test_round_hulls_get_few_vertices_and_contain_the_ball():
    ball = trimesh.creation.icosphere(4)
    hull = ConvexHull(few_vertices_around(ConvexHull(ball.vertices)))
    assert len(hull.vertices) <= 120
    heights = ball.vertices @ hull.equations[:, :3].T + hull.equations[:, 3]
    assert heights.max() <= 0.0
    assert hull.volume < 1.1 * ball.volume


def test_the_polytope_of_a_ball_contains_it_and_is_little_larger():
    points = polytope_around_ball(0.2)
    assert 0.2 <= -ConvexHull(points).equations[:, 3].max() <= 0.2001
    assert np.linalg.norm(points, axis=1).max() < 0.2075


def test_the_sides_of_a_prism_touch_the_cylinder():
    planes = ConvexHull(prism_around(0.2, (-0.1, 0.3), sides=16)).equations
    upright = np.abs(planes[:, 2]) < 0.5
    np.testing.assert_allclose(planes[upright, 3], -0.2)
    np.testing.assert_allclose(np.unique(planes[~upright, 3].round(9)), (-0.3, -0.1))


def test_the_halves_of_a_hull_fill_it():
    rng = np.random.default_rng(0)
    for _ in range(20):
        hull = convex_hull(rng.normal(size=(30, 3)) * rng.uniform(0.1, 1.0, 3))
        parts = [hull_volume(half.corners) for half in halves(hull)]
        np.testing.assert_allclose(sum(parts), hull_volume(hull.corners))
        assert min(parts) > 0.05 * sum(parts)
