"""The place task: position of the can, its grasp, and a problem for every environment."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import (
    ENVIRONMENTS,
    can_com,
    carried_can,
    grasp_region,
    mirrored_problem,
    place_problem,
)
from cvqmpt_lab.benchmarks.suite import SUITES, Suite, suite_named
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planners import planner_named
from cvqmpt_lab.problem import check_problem
from cvqmpt_lab.search.result import Budget

SHELF_COM = (0.555, -0.38, 0.742)  # link frame (0.56, -0.39, 0.642) + (-0.005, 0.010, 0.100)


def yaw_about_can(T_world_hand):
    """Yaw of the hand about the vertical [rad], 0 when it reaches along world x."""
    return np.arctan2(T_world_hand[1, 2], T_world_hand[0, 2])


@pytest.mark.parametrize(
    ("environment", "u"), [(0, (0.5488135039, 0.7151893664)), (7, (0.0763082894, 0.7799187922))]
)
def test_can_position_formula(environment, u):
    """Uses the first two uniforms of numpy's legacy generator with seed 0, from numpy's manual."""
    link = (0.4 + 0.3 * u[0], -0.6 + 1.0 * u[1], 0.171)
    np.testing.assert_allclose(
        can_com(environment), np.add(link, (-0.005, 0.010, 0.100)), atol=1e-9
    )


def test_the_carried_can_stands_upright_where_it_was_grasped():
    """Its axis is vertical through its centre of mass; its top is 0.1475 m above that."""
    com, can = np.array([0.5, -0.2, 0.271]), carried_can()
    T = grasp_region(com).sample_poses(np.random.default_rng(1), 1)[0] @ can.T_hand_object
    np.testing.assert_allclose(T[:3, 2], (0.0, 0.0, 1.0), atol=1e-12)
    np.testing.assert_allclose(T[:2, 3], com[:2], atol=1e-12)
    assert T[2, 3] + can.shape.height / 2 == pytest.approx(0.271 + 0.0265 + 0.121)
    assert T[2, 3] - can.shape.height / 2 == pytest.approx(0.271 + 0.0265 - 0.121)
    assert can.shape.radius == 0.0373


@pytest.mark.parametrize("with_can", [False, True])
def test_problems_are_sound(with_can):
    """Start and goals: on the manifold, free with a margin, grasping the can in its place."""
    problem = with_sampled_goals(place_problem(0, with_can))[0]
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
    assert new["range/block"].T_world_object[1, 3] == pytest.approx(
        -old["range/block"].T_world_object[1, 3]
    )
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
    check_problem(with_sampled_goals(mirrored)[0])


@pytest.mark.parametrize("suite", SUITES)
def test_suites_know_their_problems(suite):
    last = len(suite_named(suite).problems) - 1
    sizes = dict.fromkeys(("place-task", "place-task-with-can"), 150)
    sizes |= dict.fromkeys(("place-task-single-goal", "peers", "sensor"), 30)
    sizes |= dict.fromkeys(("place-task-mirrored", "factorial"), 60)
    sizes |= dict.fromkeys(("multi-sequence", "open-door"), 10)
    sizes |= {"constraints": 160, "factorial-constraints": 80, "robots": 180}
    assert last + 1 == sizes.get(suite, 50)
    assert suite_named(suite).item(last).name.partition("/")[0] == str(last)
    for index in (-1, last + 1, 1000):
        wrong = f"problem {index} of suite {suite}.*0 to {last}"
        with pytest.raises(InvalidInputError, match=wrong):
            suite_named(suite).item(index)


def test_a_problem_without_a_start_is_refused():
    suite = Suite("hard", range(3), lambda index: UnsolvableProblem(str(index), "no start grasp"))
    with pytest.raises(InvalidInputError, match="problem 2 of hard has no solution: no start gr"):
        suite.solvable(2)


@pytest.mark.slow
@pytest.mark.parametrize("suite", ["place-task", "place-task-with-can"])
def test_every_environment_is_solved(suite, part):
    """By birrt within 20 000 iterations, all certified; `solve` checks every start and goal."""
    planner, budget = planner_named("birrt"), Budget(iterations=20_000)
    problems = [suite_named(suite).solvable(e) for e in part(ENVIRONMENTS, 30)]
    solutions = [solve(problem, planner, budget, seed=0, clearance=False) for problem in problems]
    assert min(len(s.problem.goals) for s in solutions) >= 1
    failed = {s.problem.name: (s.plan.status, s.certificate) for s in solutions if not s.solved}
    assert failed == {}
