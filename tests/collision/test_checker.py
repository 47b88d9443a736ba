"""The compiled checker against coal: it misses no collision and reports few false ones."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.families import random_scene
from cvqmpt_lab.benchmarks.place_task import (
    carried_can,
    door_problem,
    door_world,
    place_kitchen,
)
from cvqmpt_lab.collision import arrays
from cvqmpt_lab.collision.covers import cut_into_pieces
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.cells import MAX_BALLS
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, OccupancyMap, PointCloud, Sphere
from cvqmpt_lab.search.space import ConstrainedSpace, Tolerances

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
CONTACT = 1e-5  # [m] contact is not defined below
CLOSE = 0.05  # [m] false collisions are counted among free states closer than this
AROUND = 40  # states drawn around each contact
NOTHING = Scene("nothing", ())


def compiled_hits(robot, scene, states, attachments=(), margin=0.0):
    """Return whether the compiled checker calls each state colliding (b,)."""
    start = np.append(HOME, 0.0)[: robot.dof] if robot.dof >= len(HOME) else np.zeros(robot.dof)
    problem = PlanningProblem("test", robot, scene, start, start[None], attachments=attachments)
    space = ConstrainedSpace.of(problem, tolerances=Tolerances(margin=margin))
    return np.array([not space.valid(q) for q in states])


def near_contact(checker, rng, count):
    """States (count, n) scattered by 1e-6 to 5e-2 rad around contacts found by bisection."""
    robot, n = checker.robot, count // AROUND
    states = robot.random_configurations(rng, 400)
    hit = checker.in_collision_batch(states)
    free, colliding = (rng.choice(states[side], n) for side in (~hit, hit))
    for _ in range(16):
        middle = 0.5 * (free + colliding)
        inside = checker.in_collision_batch(middle)[:, None]
        free, colliding = np.where(inside, free, middle), np.where(inside, middle, colliding)
    far = 10.0 ** rng.uniform(-6.0, -1.3, (n, AROUND, 1)) / np.sqrt(robot.dof)
    states = free[:, None] + far * rng.standard_normal((n, AROUND, robot.dof))
    return np.clip(states, robot.lower, robot.upper).reshape(-1, robot.dof)


def missed(exact, states, answers):
    """Return whether coal finds a collision in each state (b,); fail if a deep one is missed."""
    expected = exact.in_collision_batch(states)
    depths = [exact.clearance(q) - exact.margin for q in states[expected & ~answers]]
    assert expected.any() and [depth for depth in depths if depth < -CONTACT] == []
    return expected


def compare(robot, scene, count, attachments=(), margin=0.0, around=None):
    """Assert agreement on `count` uniform and near-contact states, or states around a given one."""
    rng = np.random.default_rng(0)
    what = robot, scene, attachments
    exact, close = (CollisionChecker(*what, margin + extra) for extra in (0.0, CLOSE))
    if around is None:
        near = near_contact(exact, rng, count)
    else:
        near = around + 0.15 * rng.standard_normal((count, robot.dof))
        near = np.clip(near, robot.lower, robot.upper)
    for states in (robot.random_configurations(rng, count), near):
        answers = compiled_hits(robot, scene, states, attachments, margin)
        expected = missed(exact, states, answers)
        narrow = close.in_collision_batch(states[~expected]).sum()
        assert narrow > 0 and (answers & ~expected).sum() <= 0.05 * narrow


def with_one_of_each():
    """Shapes of every kind in odd poses around the arm."""
    T = np.eye(4)
    T[:3, :3] = [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]
    corners = np.random.default_rng(1).uniform(-0.15, 0.15, (30, 3))
    shapes = (Box((0.1, 0.3, 0.2)), Cylinder(0.08, 0.4), Sphere(0.12), ConvexMesh(corners))
    places = ((0.4, 0.3, 0.4), (0.4, -0.4, 0.6), (-0.4, 0.3, 0.5), (0.3, 0.0, 0.9))
    placed = enumerate(zip(shapes, places, strict=True))
    return Scene("each", tuple(SceneObject(f"object_{i}", s, pose(p) @ T) for i, (s, p) in placed))


TOOL = pose((0.02, -0.03, 0.15), 0.4)
SPONGE = PointCloud(np.random.default_rng(6).uniform(-0.05, 0.05, (200, 3)), 0.006)
CARRIED = (Sphere(0.06), Box((0.05, 0.3, 0.1)), Cylinder(0.05, 0.3), SPONGE)


KITCHEN, CAN = place_kitchen(), (carried_can(),)
CASES = (
    *((KITCHEN, *rest) for rest in ((8000, (), 0.0), (3000, CAN, 0.0), (2000, (), 0.03))),
    (random_scene(1), 2000, CAN, 0.0),
    (NOTHING, 2000, (), 0.0),
    (with_one_of_each(), 3000, (), 0.0),
    *((random_scene(5), 1000, (Attachment("tool", shape, TOOL),), 0.0) for shape in CARRIED),
)


@pytest.mark.parametrize(("scene", "count", "attachments", "margin"), CASES)
def test_both_checkers_agree(panda, scene, count, attachments, margin):
    compare(panda, scene, count, attachments, margin)


def test_both_checkers_agree_with_a_door_in_the_hand():
    scene, robot = door_world()
    compare(robot, scene, 2000, margin=1e-4, around=door_problem(0).start)


def compared_near_contact(robot, scene, rng, most, anywhere=1000):
    """Return coal's verdicts on states anywhere, then on 3000 states near contact.

    The compiled checker misses none, and reports fewer false ones than a fraction of the first.
    """
    checker = CollisionChecker(robot, scene)
    uniform = robot.random_configurations(rng, anywhere)
    states = np.concatenate([uniform, near_contact(checker, rng, 3000)])
    answers = compiled_hits(robot, scene, states)
    expected = missed(checker, states, answers)
    assert (answers & ~expected)[:anywhere].mean() < most
    return expected


def test_another_robot(slider_arm):
    """Boxes, cylinders, spheres, slider, no SRDF; polyhedra enclose round links: loose contact."""
    scene, rng = with_one_of_each(), np.random.default_rng(0)
    compared_near_contact(slider_arm, scene, rng, 0.05, anywhere=3000)


def shell(rng, count):
    """Points (count, 3) [m] around the arm."""
    direction = rng.standard_normal((count, 3))
    far = rng.uniform(0.5, 0.9, (count, 1))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * far


TURNED = pose((0.05, -0.1, 0.4), 0.7)
TURNED[:3, :3] = TURNED[:3, :3] @ [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]


@pytest.mark.parametrize("T", [pose((0.0, 0.0, 0.4)), TURNED], ids=["straight", "turned"])
@pytest.mark.parametrize("count", [300, MAX_BALLS + 1000], ids=["balls", "cells"])
def test_clouds_that_coal_touches_are_never_called_free(panda, count, T):
    rng = np.random.default_rng(3)
    scene = Scene("cloud", (SceneObject("cloud", PointCloud(shell(rng, count), 0.005), T),))
    assert compared_near_contact(panda, scene, rng, 0.02)[1000:].mean() > 0.2


def touching_ball(piece, T_world_piece, radius, depth, rng):
    """Centre (3,) of a ball `depth` [m] deep in a face of a convex piece, and its normal (3,)."""
    hull = ConvexHull(piece.vertices)
    face = rng.integers(len(hull.simplices))
    normal = T_world_piece[:3, :3] @ hull.equations[face, :3]
    point = rng.dirichlet(np.ones(3)) @ piece.vertices[hull.simplices[face]]
    return T_world_piece[:3, :3] @ point + T_world_piece[:3, 3] + (radius - depth) * normal, normal


@pytest.mark.parametrize("count", [1, MAX_BALLS, MAX_BALLS + 1, 5000])
@pytest.mark.parametrize("carried", [False, True], ids=["obstacle", "carried"])
def test_what_a_ball_touches_its_cloud_touches(panda, count, carried):
    """The other balls of the cloud stay clear of the face that the ball is in."""
    rng = np.random.default_rng(count)
    q = HOME + 0.3 * rng.uniform(-1.0, 1.0, 7)
    T_hand = panda.pose(q)
    frames = {panda.link_of(name)[0]: name for name in panda.frame_names}
    pieces = [piece for piece in panda.links if 0 < piece.link <= (3 if carried else 9)]
    for trial in range(6 if carried else 20):
        piece, radius = pieces[rng.integers(len(pieces))], 10.0 ** rng.uniform(-2.7, -0.9)
        name = frames[piece.link]
        T_world_link = panda.pose(q, name) @ np.linalg.inv(panda.link_of(name)[1])
        depth = 10.0 ** rng.uniform(-4.5, -3.0)
        T_world_piece = T_world_link @ piece.T_link_geometry
        ball, normal = touching_ball(piece, T_world_piece, radius, depth, rng)
        others = rng.uniform(-6.0, 6.0, (count - 1, 3)) * min(radius, 0.05)
        height = others @ normal
        others += np.outer(np.abs(height) - height + 3.0 * radius, normal)  # beyond the face
        points = ball + np.concatenate([np.zeros((1, 3)), others])
        frame = pose(rng.uniform(-0.1, 0.1, 3), rng.uniform(-3.0, 3.0))
        T = (T_hand if carried else TURNED) @ frame
        cloud = PointCloud((points - T[:3, 3]) @ T[:3, :3], radius)
        scene, attachments = Scene("cloud", (SceneObject("cloud", cloud, T),)), ()
        if carried:
            scene, attachments = NOTHING, (Attachment("cloud", cloud, np.linalg.inv(T_hand) @ T),)
        assert CollisionChecker(panda, scene, attachments).in_collision(q), (trial, radius)
        assert compiled_hits(panda, scene, q[None], attachments).all(), (trial, radius)


@pytest.mark.parametrize("padding", [0.0, 0.03])
@pytest.mark.parametrize("T", [pose((0.0, 0.0, 0.4)), TURNED], ids=["straight", "turned"])
def test_maps_are_the_same_to_both_checkers(panda, T, padding):
    """Also for a coarse wall and solid blocks, whose cells are joined to large boxes."""
    rng = np.random.default_rng(5)
    scattered = np.floor(shell(rng, 600) / 0.02)
    wall = np.argwhere(np.ones((2, 40, 30), dtype=bool)) + (22, -20, -10)
    block = np.argwhere(np.ones((6, 6, 6), dtype=bool)) - (25, 3, 0)
    cells = np.concatenate([scattered, wall, block])
    scene = Scene("map", (SceneObject("map", OccupancyMap(cells, 0.02, padding), T),))
    compare(panda, scene, 2000, margin=1e-4)


def test_obstacles_outside_the_grid_are_still_seen_and_states_that_are_not_finite_collide(panda):
    """The distance grid ends at the arm's reach; a pole in the hand extends beyond it."""
    pole = Attachment("pole", Box((0.02, 0.02, 1.6)), pose((0.0, 0.0, 0.9)))
    stretched = np.array([0.0, 1.5, 0.0, -0.1, 0.0, 1.5, 0.0])
    T_world_tip = panda.pose(stretched) @ pose((0.0, 0.0, 1.65))
    scene = Scene("far", (SceneObject("far", Sphere(0.05), T_world_tip),))
    assert np.linalg.norm(T_world_tip[:3, 3]) > panda.reach
    assert compiled_hits(panda, scene, [stretched], (pole,)) == [True]
    assert compiled_hits(panda, scene, [stretched]) == [False]
    states = np.array([HOME, np.full(7, np.nan), np.full(7, np.inf)])
    assert compiled_hits(panda, NOTHING, states).tolist() == [False, True, True]


def test_a_robots_arrays_are_made_once_and_the_same_from_disk(slider_arm, tmp_path, monkeypatch):
    """Arrays are built once; tests/robot/test_loading has damaged cache files."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def stored(length):
        bar = Attachment("bar", Box((0.1, 0.1, length)), pose((0.0, 0.0, 0.1)))
        return arrays.robot_arrays.__wrapped__(slider_arm, (bar,))

    first, longer = stored(0.12), stored(0.4)
    monkeypatch.setattr(arrays, "robot_geometry", lambda *_: pytest.fail("it was made again"))
    again = stored(0.12)
    assert type(again) is type(first) and again.body_swing.shape[1] == slider_arm.dof
    for one, other in zip((*first.pieces, *first[1:]), (*again.pieces, *again[1:]), strict=True):
        np.testing.assert_array_equal(one, other)
        assert np.asarray(one).dtype == np.asarray(other).dtype
    assert len(longer.sphere) > len(first.sphere)


def test_flat_shapes_are_cut_too():
    """Cut a point, a segment, a square and coincident points."""
    square = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]]
    segment = np.outer([0.0, 1.0, 0.4], np.eye(3)[0])
    for points in (np.zeros((1, 3)), segment, np.array(square), np.zeros((4, 3))):
        corners = np.concatenate(cut_into_pieces(points))
        assert len(corners) < 2000
        for end in (np.min, np.max):
            np.testing.assert_allclose(end(corners, axis=0), end(points, axis=0), atol=1e-12)
