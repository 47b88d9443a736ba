"""The place task, the constraint and family tasks: a sound problem for every index."""

from functools import partial
from importlib import import_module

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from cvqmpt_lab.benchmarks import family_task
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.family_task import (
    ARM_SOURCES,
    CONSTRAINT_KINDS,
    constraint_problem,
    family_problem,
    other_robot_problem,
    trivial,
)
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import (
    can_com,
    mirrored_problem,
    place_problem,
)
from cvqmpt_lab.benchmarks.results.row import split_problem
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.benchmarks.suite_parts import Suite
from cvqmpt_lab.planning.pipeline import solve, with_drawn_goals
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.planning.usable import check_problem
from cvqmpt_lab.robot.robot import SLOW_SPEED
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace

SHELF_COM = (0.555, -0.38, 0.742)  # link frame (0.56, -0.39, 0.642) + (-0.005, 0.010, 0.100)


def yaw_about_can(T_world_hand):
    """Yaw of the hand about the vertical [rad], 0 when it reaches along world x."""
    return np.arctan2(T_world_hand[1, 2], T_world_hand[0, 2])


@pytest.mark.parametrize("with_can", [False, True])
def test_problems_are_sound(with_can):
    """Start and goals: on the manifold, free with a margin, grasping the can in its place."""
    problem = with_drawn_goals(place_problem(0, with_can))
    check_problem(problem)
    assert len(problem.attachments) == with_can and problem.name == "0"
    assert len(problem.goals) == 20
    roomy = problem.collision_checker(0.0009)  # sampled with 1 mm
    lifted = can_com(0) + (0.0, 0.0, 0.005 * with_can)
    for q, com in [(problem.start, lifted), *((q, SHELF_COM) for q in problem.goals)]:
        T = problem.robot.pose(q)
        grasped = np.add(com, (0.0, 0.0, 0.05))
        np.testing.assert_allclose(T[:3, 3] + 0.11 * T[:3, 2], grasped, atol=1e-5)
        assert abs(yaw_about_can(T)) <= np.pi / 2 + 1e-5 and not roomy.in_collision(q)
    tilt = Rotation.from_matrix(problem.robot.pose(problem.start)[:3, :3]).apply((1, 0, 0))
    np.testing.assert_allclose(tilt, (0.0, 0.0, 1.0), atol=1e-5)


def test_the_mirrored_kitchen_is_the_same_modules_on_the_other_side():
    """Left and right swap, walls keep their distance, the can is in the shelf's open cabinet."""
    known, mirrored = (place_problem(7), mirrored_problem(7))
    old, new = ({item.name: item for item in p.scene.objects} for p in (known, mirrored))
    assert list(old) == list(new) and mirrored.scene.articulations == ()
    sides = [items["range/block"].T_world_object[1, 3] for items in (old, new)]
    assert sides[1] == pytest.approx(-sides[0])
    # open: parallel to the cabinet's sides, now left
    panel = new["dagger_door_left/panel"].T_world_object
    assert panel[1, 3] > 0.0 > old["dagger_door_left/panel"].T_world_object[1, 3]
    assert np.linalg.det(panel) == pytest.approx(1.0)
    T = mirrored.robot.pose(mirrored.start)
    com = T[:3, 3] + 0.11 * T[:3, 2] - (0.0, 0.0, 0.05)
    np.testing.assert_allclose(com, can_com(7) * (1.0, -1.0, 1.0), atol=1e-5)
    shelf = mirrored.goal_region.T0_w[:3, 3]
    sides = [new[f"dagger/cell1_side_{side}"].T_world_object[1, 3] for side in ("left", "right")]
    assert min(sides) + 0.05 < shelf[1] < max(sides) - 0.05
    check_problem(with_drawn_goals(mirrored))


@pytest.mark.parametrize("suite", SUITES)
def test_suites_know_their_problems(suite):
    first, last = (suite_named(suite).problems[end] for end in (0, -1))
    if suite.startswith("motion-bench"):
        return  # needs an archive, see test_motion_bench
    assert suite_named(suite).item(last).name.partition("/")[0] == str(last)
    for index in (-1, last + 1, 10**6):
        told = f"problem {index} of suite {suite}.*{first} to {last}"
        refused(told, suite_named(suite).item, index)


@pytest.mark.parametrize("suite", SUITES.values(), ids=SUITES)
def test_the_functions_that_a_suite_names_exist(suite):
    for named in (suite.make, suite.table, suite.shown_in_hand):
        function = named.func if isinstance(named, partial) else named
        if function is not None:
            module, _, name = function.name.partition(":")
            assert callable(getattr(import_module(module), name))


def test_a_suite_of_tasks_times_them_at_the_slow_speed():
    speeds = {suite.settings["speed"] for suite in SUITES.values() if suite.of_tasks}
    assert speeds == {SLOW_SPEED}


def test_a_problem_without_a_start_is_refused():
    suite = Suite(
        name="hard",
        title="Hard",
        problems=range(3),
        make=lambda index: UnsolvableProblem(str(index), "no start grasp"),
    )
    refused("problem 2 of hard has no solution: no start grasp", suite.solvable, 2)


@pytest.mark.slow
@pytest.mark.parametrize("suite", ["place-task", "place-task-with-can"])
def test_every_environment_is_solved(suite, part):
    """By birrt within 20 000 iterations, all certified; `solve` checks every start and goal."""
    planner, budget = planner_named("birrt"), Budget(iterations=20_000)
    environments = part(suite_named(suite).problems, 30)
    problems = [suite_named(suite).solvable(e) for e in environments]
    solutions = [solve(problem, planner, budget, seed=0) for problem in problems]
    assert min(len(s.goals) for s in solutions) >= 1
    failed = {s.problem.name: (s.plan.status, s.certificate) for s in solutions if not s.solved}
    assert failed == {}


ATTACHED = {"tray": ["tray"], "pouring": ["carried_can"]}
ATTACHED["door"] = ["panel", "handle_bar", "handle_post_lower", "handle_post_upper"]


@pytest.mark.parametrize("kind", CONSTRAINT_KINDS)
def test_problems_of_a_kind_start_and_end_free_on_the_manifold_and_not_straight_ahead(kind):
    index = 8 * 61 + CONSTRAINT_KINDS.index(kind)
    problem, again = constraint_problem(index), constraint_problem(index)
    assert split_problem(problem.name).phase == kind and index >= 160
    np.testing.assert_array_equal(problem.start, again.start)
    np.testing.assert_array_equal(problem.goals, again.goals)
    check_problem(problem)
    assert len(problem.goals) > 0 and not trivial(problem)
    assert [item.name for item in problem.attachments] == ATTACHED.get(kind, [])
    hands = [problem.robot.pose(q)[:3, 3] for q in (problem.start, problem.goals[0])]
    assert np.linalg.norm(hands[1] - hands[0]) > 0.8 * 0.25


def test_a_door_stays_on_its_hinge():
    problem = constraint_problem(8 * 60 + CONSTRAINT_KINDS.index("door"))
    panel = next(item for item in problem.attachments if item.name == "panel")
    hinge = problem.constraint[0].T0_w
    edges = []
    for q in (problem.start, *problem.goals):
        T = np.linalg.inv(hinge) @ problem.robot.pose(q) @ panel.T_hand_object
        edges.append((np.hypot(*T[:2, 3]), T[2, 3]))
    np.testing.assert_allclose(edges, [edges[0]] * len(edges), atol=5e-3)


@pytest.mark.parametrize(
    ("robot", "index", "family", "number"),
    [("panda", 1, "table", 2001), ("z1", 5, "table", 2105), ("panda", 19, "kitchen-like", 2039)],
)
def test_a_robot_gets_the_first_scene_of_its_family_that_holds_a_problem(
    robot, index, family, number
):
    source, problem = ARM_SOURCES[robot], other_robot_problem(robot, index)
    expected = family_problem(family, number, source)
    assert problem.scene.name.endswith(f"_{number}")
    np.testing.assert_array_equal(problem.start, expected.start)
    np.testing.assert_array_equal(problem.goal_region.T0_w, problem.robot.pose(expected.goals[0]))
    assert not any(map(holds_problem(family, source), range(2000 + index, number, 20)))


def holds_problem(family, *source):
    return lambda k: not isinstance(family_problem(family, k, *source), UnsolvableProblem)


def test_a_robot_without_a_problem_in_all_scenes_is_reported_in_one_line(monkeypatch):
    tried = []

    def none(family, number, robot_source):
        tried.append(number)
        return UnsolvableProblem(str(number), f"nothing in {family} {number}")

    monkeypatch.setattr(family_task, "family_problem", none)
    found = other_robot_problem("ur5", 3)
    assert found == UnsolvableProblem("3", "nothing in kitchen-like 2383, the last of 20 scenes")
    assert tried == list(range(2003, 2400, 20))


@pytest.mark.parametrize("family", ["cubes-spheres", "shelves"])
def test_family_problems_start_and_end_upright_and_free(family):
    for number in (0, 1001):
        problem = family_problem(family, number)
        check_problem(problem)
        space = ConstrainedSpace.of(problem)
        assert not motion_free(space.arrays, problem.start, problem.goals[0])
