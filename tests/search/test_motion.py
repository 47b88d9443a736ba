"""Straight motions are free for coal; the index of nodes is that of a plain search."""

from itertools import pairwise

import numpy as np
import pytest
from compiled_kernels import from_python
from properties.test_differential import near_contact

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.certificate.between_states import largest_violation
from cvqmpt_lab.certificate.certificate import CERTIFICATE_TOLERANCE, CHECK_SPACING_RAD
from cvqmpt_lab.collision.arrays import robot_swing
from cvqmpt_lab.constraints.task_space_region import FREE, symmetric_region
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Sphere
from cvqmpt_lab.search.motion import blocked_segment, motion_free, states_valid
from cvqmpt_lab.search.nearest import (
    NODES_PER_BLOCK,
    NODES_PER_LEAF,
    enlarged_index,
    index_new_nodes,
    nearest_index,
    nearest_node,
)
from cvqmpt_lab.search.space import ConstrainedSpace

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
HEAD = ConvexMesh(np.random.default_rng(0).uniform(-0.1, 0.1, (12, 3)))
HAMMER = (
    Attachment("handle", Box((0.03, 0.04, 0.5)), pose((0.02, -0.01, 0.3), 0.4)),
    Attachment("head", HEAD, pose((0.0, 0.2, 0.5))),
)
FINE = 0.002  # [rad]


def placed_points(robot, attachments, configurations):
    """World positions (k, p, 3) of every vertex of the links and of what is carried."""
    rotations, translations = link_poses(robot.kinematics, configurations)
    hand, T_link_hand = robot.hand()
    solids = [(piece.link, piece.T_link_geometry, piece.vertices) for piece in robot.links]
    solids += [(hand, T_link_hand @ a.T_hand_object, a.shape.vertices) for a in attachments]
    points = [
        (vertices @ T[:3, :3].T + T[:3, 3]) @ rotations[:, link].transpose(0, 2, 1)
        + translations[:, link, None]
        for link, T, vertices in solids
    ]
    return np.concatenate(points, axis=1)


@pytest.mark.parametrize("name", ["panda", "slider_arm"])
@pytest.mark.parametrize("attachments", [(), HAMMER])
def test_no_point_moves_further_than_its_swing(request, name, attachments):
    robot = request.getfixturevalue(name)
    bound = robot_swing(robot, attachments)
    rng = np.random.default_rng(0)
    before = robot.random_configurations(rng, 1000)
    change = 10.0 ** rng.uniform(-4.0, 0.3, (1000, 1)) * rng.standard_normal(before.shape)
    # motions of single joints come closest to the bound
    change[:300] *= np.eye(robot.dof)[rng.integers(robot.dof, size=300)]
    after = np.clip(before + change, robot.lower, robot.upper)
    moved = placed_points(robot, attachments, after) - placed_points(robot, attachments, before)
    furthest = np.linalg.norm(moved, axis=2).max(axis=1)
    allowed = np.abs(after - before) @ bound
    assert (furthest <= allowed + 1e-12).all()
    # a looser bound would make every motion slow to check
    assert (furthest / allowed).max() > 0.8


@pytest.fixture(scope="module")
def kitchen_problem(panda, open_kitchen):
    return PlanningProblem("kitchen", panda, open_kitchen, HOME, HOME[None])


@pytest.fixture(scope="module")
def kitchen_space(kitchen_problem):
    return ConstrainedSpace.of(kitchen_problem)


@pytest.fixture(scope="module")
def motions(kitchen_problem, kitchen_space):
    """Free states a, b (k, n) up to 0.3 rad apart, on either side of a contact."""
    rng, robot = np.random.default_rng(0), kitchen_space.robot
    free = near_contact(kitchen_problem, kitchen_space, rng, 1000)
    contacts = np.repeat(free, 30, axis=0)
    away = rng.standard_normal((2, *contacts.shape))
    far = rng.uniform(0.0, 0.15, (2, len(contacts), 1))
    away *= far / np.linalg.norm(away, axis=2, keepdims=True)
    a, b = np.clip(contacts + away, robot.lower, robot.upper)
    free = all_free(kitchen_space, np.stack([a, b], axis=1))
    return a[free], b[free]


@pytest.fixture(scope="module")
def answers(kitchen_space, motions):
    """Return `motion_free` of each motion (k,)."""
    arrays = kitchen_space.arrays
    return np.array([motion_free(arrays, a, b) for a, b in zip(*motions, strict=True)])


def all_free(space, states):
    """Return whether the compiled checker calls all states of each row (k, s, n) free (k,)."""
    out = np.empty(states.shape[0] * states.shape[1], dtype=bool)
    states_valid(space.arrays, np.ascontiguousarray(states.reshape(-1, states.shape[2])), out)
    return out.reshape(states.shape[:2]).all(axis=1)


def along(motions, spacing):
    """Return states (k, s, n) of straight motions; s is the number that the longest one needs."""
    a, b = motions
    longest = np.linalg.norm(b - a, axis=1).max()
    return np.linspace(a, b, 1 + int(np.ceil(longest / spacing)), axis=1)


def test_motions_called_free_are_free_for_coal(kitchen_problem, kitchen_space, motions, answers):
    """coal checks many states, not only those that the kernels checked."""
    checker = kitchen_problem.collision_checker()
    a, b = (ends[answers] for ends in motions)
    close = np.flatnonzero(~all_free(kitchen_space, along((a, b), FINE)))  # by less than the margin
    rest = np.random.default_rng(0).choice(len(a), 300, replace=False)
    motions = {k: along((a[k : k + 1], b[k : k + 1]), FINE)[0] for k in {*close, *rest}}
    assert [k for k, states in motions.items() if checker.in_collision_batch(states).any()] == []


def test_motions_are_refused_where_sampling_finds_a_collision(kitchen_space, motions, answers):
    sampled = all_free(kitchen_space, along(motions, kitchen_space.arrays.resolution))
    assert (~sampled).sum() >= 30 and answers[~sampled].mean() <= 0.1
    assert (answers != sampled).mean() < 0.02
    a = motions[0][0]
    assert motion_free(kitchen_space.arrays, a, a)
    assert not motion_free(kitchen_space.arrays, a, np.full(7, np.nan))


def test_what_only_the_middle_of_a_motion_meets_is_noticed(panda):
    """A finger sweeps over a small ball and touches it; with a lower ball the motion is free."""
    a, b = HOME - 0.1 * np.eye(7)[0], HOME + 0.1 * np.eye(7)[0]

    def answer(depth):
        place = panda.pose(HOME) @ pose((0.0, 0.05, depth))
        scene = Scene("ball", (SceneObject("ball", Sphere(0.005), place),))
        space = ConstrainedSpace.of(PlanningProblem("ball", panda, scene, a, b[None]))
        return space.valid(a), space.valid(b), motion_free(space.arrays, a, b)

    assert answer(0.1) == (True, True, False)
    assert answer(0.13) == (True, True, True)


def test_a_path_is_proven_like_its_motions(kitchen_space, motions, answers):
    """Also a path of one state, doubled states, and ends that are the same."""
    arrays, rng = kitchen_space.arrays, np.random.default_rng(60)
    for k in range(200):
        a, b = motions[0][k], motions[1][k]
        shares = np.sort(rng.choice([0.0, 0.2, 0.5, 0.5, 0.9, 1.0], 9))
        there = a + np.concatenate([[0.0], shares, [1.0]])[:, None] * (b - a)
        back = np.concatenate([there, there[::-1]])
        blocked = blocked_segment(arrays, back, len(back))
        assert (blocked < 0) == motion_free(arrays, a, b)
        assert blocked < len(back) - 1
    assert blocked_segment(arrays, back[:1], 1) == -1


def test_the_blocked_segment_of_a_path_holds_a_collision(kitchen_space, motions, answers):
    """Paths go from one free state to the next, in all directions."""
    arrays, free = kitchen_space.arrays, motions[0]
    verdicts = []
    for k in range(0, 600, 6):
        path = np.ascontiguousarray(free[k : k + 6])
        blocked = blocked_segment(arrays, path, len(path))
        verdicts.append(blocked)
        alone = [motion_free(arrays, *ends) for ends in pairwise(path)]
        assert all(alone) if blocked < 0 else not alone[blocked]
    assert 5 < sum(blocked < 0 for blocked in verdicts) < 95


index_new_nodes, nearest_node = map(from_python, (index_new_nodes, nearest_node))


def walks(rng, count, n=7):
    """Return nodes like those of trees: short steps from earlier nodes."""
    nodes = np.zeros((count, n))
    for k in range(1, count):
        origin = nodes[k - 1] if k % 7 else nodes[rng.integers(k)]
        nodes[k] = origin + 0.15 * rng.standard_normal(n)
    return nodes


BLOCKS = (
    1,
    NODES_PER_BLOCK - 1,
    NODES_PER_BLOCK,
    NODES_PER_BLOCK + 1,
    5 * NODES_PER_BLOCK + 77,
    16 * NODES_PER_BLOCK,
)


def queries(rng, nodes, count):
    """Return query points near the nodes, between them, and far away."""
    picks = nodes[rng.integers(len(nodes), size=(count, 2))]
    spread = 10.0 ** rng.uniform(-4.0, 0.7, (count, 1))
    # not half-way, where rounding decides which of two nodes is nearer
    share = rng.uniform(size=(count, 1))
    between = picks[:, 0] + share * (picks[:, 1] - picks[:, 0])
    return np.concatenate([picks[:, 0] + spread * rng.standard_normal(between.shape), between])


@pytest.mark.parametrize(
    "count",
    [
        1,
        NODES_PER_BLOCK - 1,
        NODES_PER_BLOCK,
        NODES_PER_BLOCK + 1,
        5 * NODES_PER_BLOCK + 77,
        16 * NODES_PER_BLOCK,
    ],
)
def test_the_nearest_node_is_that_of_a_plain_search(count):
    """The nearest node is correct also after the index has grown."""
    rng = np.random.default_rng(count)
    nodes, index = walks(rng, count), nearest_index(2 * NODES_PER_BLOCK, 7)
    for size in (*range(0, count, 128), count):
        if size > index.order.shape[1]:
            index = enlarged_index(index, 2 * index.order.shape[1])
        index_new_nodes(index, 1, nodes, size)
    assert index.indexed.tolist() == [0, count // NODES_PER_BLOCK * NODES_PER_BLOCK]
    for target in queries(rng, nodes, 150):
        assert nearest_node(index, 1, nodes, count, target) == nearest_of_all(nodes, target)


def nearest_of_all(nodes, target):
    return int(((nodes - target) ** 2).sum(axis=1).argmin())


def test_of_equal_nodes_the_first_is_found_and_those_moved_away_later_never():
    """A removed node is moved far away; the index is not told."""
    rng, few = np.random.default_rng(2), walks(np.random.default_rng(1), 3 * NODES_PER_LEAF)
    for nodes, gone in ((np.tile(few, (100, 1)), 0), (walks(rng, 3 * NODES_PER_BLOCK), 1000)):
        index = nearest_index(len(nodes), 7)
        index_new_nodes(index, 0, nodes, len(nodes))
        nodes[rng.choice(len(nodes), gone, replace=False), 0] = 1e6
        targets = np.clip(queries(rng, nodes[:50], 50), -5.0, 5.0)
        for target in targets if gone else nodes[[0, 7, 3 * NODES_PER_LEAF - 1]]:
            found = nearest_node(index, 0, nodes, len(nodes), target)
            assert found == nearest_of_all(nodes, target)


@pytest.mark.parametrize("tolerance", [0.0, 1e-4, 0.01])
def test_refined_motions_keep_narrow_bounds_as_the_certificate_asks(panda, tolerance):
    # constrain a point 0.6 m in front of the hand, so that short motions leave the plane
    bounds = [FREE, FREE, tolerance, FREE, FREE, FREE]
    flat = symmetric_region(pose((0.0, 0.0, 0.5)), pose((0.0, 0.0, -0.6)), bounds)
    problem = PlanningProblem("flat", panda, Scene("empty", ()), HOME, HOME[None], (flat,))
    space, rng = ConstrainedSpace.of(problem), np.random.default_rng(0)
    found = 0
    for begin in panda.random_configurations(rng, 600):
        direction = rng.normal(size=panda.dof)
        space.project(begin)
        end = begin + 1.4 * space.arrays.step * direction / np.linalg.norm(direction)
        space.project(end)
        path, _ = space.checked_path(np.array([begin, end]))
        if path is not None:
            found += 1
            worst = largest_violation(
                panda, (flat,), path.states, CHECK_SPACING_RAD, CERTIFICATE_TOLERANCE
            )
            assert worst.largest <= CERTIFICATE_TOLERANCE
    assert found > 450
