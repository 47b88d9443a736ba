"""Parts of the compiled collision checks against coal: shapes, balls and pieces, distance grid."""

import coal
import numpy as np
import pytest
from compiled_kernels import from_python
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from cvqmpt_lab.collision import separation
from cvqmpt_lab.collision.covers import ANY_RADIUS, Piece, cut_into_pieces, sphere_trees
from cvqmpt_lab.collision.distance_grid import RANGE, cell_of, known_distance
from cvqmpt_lab.collision.geometry import ShapeSpec, outline, pack_shapes, scene_geometry
from cvqmpt_lab.collision.separation import BOX, CYLINDER, HULL, IDENTITY, SPHERE
from cvqmpt_lab.robot.hulls import coal_distance, convex_hull

cell_of, known_distance = map(from_python, (cell_of, known_distance))
distance, separating_gap = map(from_python, (separation.distance, separation.separating_gap))
MARGIN = 1e-4
KINDS = HULL, BOX, CYLINDER, SPHERE
NO_VERTICES = np.empty((0, 3))


def pose(R=None, t=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if R is None else R
    T[:3, 3] = t
    return T


def random_spec(rng, kind, spread=0.25, longest=0.2):
    T = pose(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), spread * rng.normal(size=3))
    if kind == HULL:
        points = rng.normal(size=(rng.integers(4, 80), 3))
        points *= rng.uniform(0.2, 1.0, 3) * longest / np.linalg.norm(points, axis=1)[:, None]
        return ShapeSpec(HULL, (), points, T)
    a, b, c = rng.uniform(0.02, longest, 3)
    size = {BOX: (a, b, c), CYLINDER: (a, a, b), SPHERE: (a,)}[kind]
    return ShapeSpec(kind, size, NO_VERTICES, T)


def coal_object(spec):
    T, size = spec.T_owner_shape, spec.size
    make = {
        BOX: lambda: coal.Box(*size),
        CYLINDER: lambda: coal.Cylinder(size[0], size[2]),
        SPHERE: lambda: coal.Sphere(size[0]),
        HULL: lambda: convex_hull(spec.vertices),
    }
    return make[spec.kind](), coal.Transform3s(T[:3, :3], T[:3, 3])


@pytest.mark.parametrize("kind_a", KINDS)
@pytest.mark.parametrize("kind_b", KINDS)
def test_pairs_agree_with_coal(kind_a, kind_b):
    """Random pairs, half of them slid to within a millimetre of contact."""
    rng = np.random.default_rng(10 * kind_a + kind_b)
    for k in range(240):
        a, b = random_spec(rng, kind_a), random_spec(rng, kind_b)
        objects = coal_object(a), coal_object(b)
        if k % 2:
            result = coal.DistanceResult()
            apart = coal.distance(*objects[0], *objects[1], coal.DistanceRequest(), result)
            if apart > 0.0:
                gap = result.getNearestPoint1() - result.getNearestPoint2()
                shift = gap * (1.0 - rng.uniform(-1e-3, 1e-3) / apart)
                b = b._replace(T_owner_shape=pose(t=shift) @ b.T_owner_shape)
                objects = objects[0], coal_object(b)
        exact = coal_distance(*objects[0], *objects[1])
        packed = pack_shapes([a, b])
        axis = tuple(a.T_owner_shape[:3, 3] - b.T_owner_shape[:3, 3])
        gap = separating_gap(packed, 0, packed, 1, IDENTITY, axis, MARGIN, MARGIN, 1e-9)
        assert not (gap > MARGIN and exact <= MARGIN - 2e-6), (k, gap, exact)
        assert not (gap <= MARGIN and exact > 2e-4), (k, gap, exact)
        certified = distance(packed, 0, packed, 1, IDENTITY, axis, 1e-7)
        assert certified <= max(exact, 0.0) + 2e-6
        assert certified >= exact - 2e-5


def test_a_touching_pair_is_a_collision_and_a_degenerate_axis_is_harmless():
    box = ShapeSpec(BOX, (0.2, 0.2, 0.2), NO_VERTICES, pose())
    for offset, free in ((0.2, False), (0.2 + 0.5 * MARGIN, False), (0.2 + 2 * MARGIN, True)):
        shapes = pack_shapes([box, box._replace(T_owner_shape=pose(t=(0.0, offset, 0.0)))])
        for axis in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (np.nan, 0.0, 0.0)):
            gap = separating_gap(shapes, 0, shapes, 1, IDENTITY, axis, MARGIN, MARGIN, 1e-9)
            assert (gap > MARGIN) == free


@pytest.mark.parametrize("kind", KINDS)
def test_balls_and_pieces_cover_the_shape(kind):
    rng = np.random.default_rng(kind)
    for _ in range(3):
        spec = random_spec(rng, kind, longest=0.5)
        points, inflation = outline(spec)
        parts = cut_into_pieces(points) if inflation == 0.0 else [points]
        tree = sphere_trees([[Piece(part, inflation, i) for i, part in enumerate(parts)]])
        leaves = tree.sphere[tree.leaf >= 0]
        assert sorted(tree.leaf[tree.leaf >= 0]) == list(range(len(parts)))
        assert inflation > 0.0 or leaves[:, 3].max() <= ANY_RADIUS + 1e-6
        samples = rng.dirichlet(np.full(len(points), 0.3), 2000) @ points
        direction = rng.normal(size=samples.shape)
        samples = samples + inflation * direction / np.linalg.norm(direction, axis=1)[:, None]
        apart = np.linalg.norm(samples[:, None] - leaves[None, :, :3], axis=2) - leaves[None, :, 3]
        assert apart.min(axis=1).max() <= 0.0
        if inflation == 0.0:
            homogeneous = np.c_[samples, np.ones(2000)].T
            in_piece = [np.max(ConvexHull(part).equations @ homogeneous, axis=0) for part in parts]
            assert np.min(in_piece, axis=0).max() < 1e-9
        for node, (sphere, skip) in enumerate(zip(tree.sphere, tree.skip, strict=True)):
            assert node < skip <= len(tree.skip)
            below = [parts[k] for k in tree.leaf[node:skip] if k >= 0]
            furthest = np.linalg.norm(np.concatenate(below) - sphere[:3], axis=1).max()
            assert furthest + inflation <= sphere[3] + 1e-12


def test_flat_shapes_are_cut_too():
    """A point, a segment, a square and points that coincide."""
    square = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]]
    segment = np.outer([0.0, 1.0, 0.4], np.eye(3)[0])
    for points in (np.zeros((1, 3)), segment, np.array(square), np.zeros((4, 3))):
        corners = np.concatenate(cut_into_pieces(points))
        assert len(corners) < 2000
        for end in (np.min, np.max):
            np.testing.assert_allclose(end(corners, axis=0), end(points, axis=0), atol=1e-12)


def test_grid_never_overestimates_and_is_not_idle():
    rng = np.random.default_rng(4)
    specs = [random_spec(rng, kind) for kind in (BOX, BOX, SPHERE)]
    scene = scene_geometry(specs, (), 0.6)
    objects = [coal_object(spec) for spec in specs]
    slack = []
    for point in rng.uniform(-0.6, 0.6, (800, 3)):
        ix, iy, iz, inside = cell_of(scene.grid, *point)
        assert inside
        probe = coal.Sphere(1e-9), coal.Transform3s(np.eye(3), point)
        exact = max(min(coal_distance(*probe, *other) for other in objects), 0.0)
        known = known_distance(scene.grid, ix, iy, iz)
        assert known <= exact + 2e-6
        slack.append(min(exact, RANGE) - known)
    assert np.max(slack) < 2.5 * scene.grid.cell
    assert np.median(slack) < scene.grid.cell
    assert not cell_of(scene.grid, 0.0, 0.0, 9.0)[3]
