"""Gaps between hulls and meshes, rooms inside closed meshes, polytopes with few planes."""

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from cvqmpt_lab.base.convex_pieces import convex_pieces, hull_gap, polytope_around


def box(size, at=(0.0, 0.0, 0.0)):
    return trimesh.creation.box(size, transform=trimesh.transformations.translation_matrix(at))


def test_the_gap_of_a_hull_is_the_depth_of_the_space_that_it_fills():
    assert hull_gap(np.array(box((0.2, 0.3, 0.4)).triangles)) == 0.0
    channel = trimesh.util.concatenate(
        [box((1.0, 0.5, 0.02)), *(box((1.0, 0.02, 0.5), (0.0, y, 0.25)) for y in (-0.24, 0.24))]
    )
    # the points in the middle are 0.23 m from both sides
    assert abs(hull_gap(np.array(channel.triangles)) - 0.23) < 0.03


def test_a_room_with_walls_all_around_stays_empty():
    inner = box((1.8, 1.8, 1.8))
    inner.invert()
    triangles = np.array(trimesh.util.concatenate([box((2.0, 2.0, 2.0)), inner]).triangles)
    assert hull_gap(triangles) > 0.8
    rng = np.random.default_rng(0)
    inside, wall = rng.uniform(-0.7, 0.7, (200, 3)), rng.uniform(-1.0, 1.0, (2000, 3))
    wall = wall[np.abs(wall).max(axis=1) > 0.9]
    hulls = [ConvexHull(piece).equations for piece in convex_pieces(triangles)]

    def held(points):
        away = [(points @ planes[:, :3].T + planes[:, 3]).max(axis=1) for planes in hulls]
        return np.min(away, axis=0) < 1e-7

    assert not held(inside).any() and held(wall).all()


def test_a_polytope_of_few_planes_contains_all_points():
    points = trimesh.creation.cone(0.1, 0.2, sections=300).vertices
    for most in (200, 60):
        corners, beyond = polytope_around(points, most)
        planes = ConvexHull(corners).equations
        assert (points @ planes[:, :3].T + planes[:, 3]).max() < 1e-12
        assert 0.0 < beyond < 0.002
