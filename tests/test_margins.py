"""Margins of planning, and the deviations that a certificate reports as tolerated."""

from dataclasses import replace

import numpy as np
import pytest
from small_arms import gantry, problem_of

from cvqmpt_lab.base.poses import pose, rotation_matrices
from cvqmpt_lab.certificate.between_states import least_slack
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.cli.problem_options import MARGIN
from cvqmpt_lab.constraints.goals import goals_of
from cvqmpt_lab.constraints.task_space_region import displacements, excess
from cvqmpt_lab.features.plan import Request, plan
from cvqmpt_lab.features.tasks.solve import solve_task
from cvqmpt_lab.planning.margins import (
    NO_MARGIN,
    Kept,
    Margin,
    kept_by,
    with_margin,
)
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Sphere
from cvqmpt_lab.search.result import Budget, JointPath


def with_margin_of(problem, *settings, **more):
    """Return the solution of a plan, and its margin in words."""
    planned = plan(problem, Request("birrt", *settings, **more))
    return planned.solution, str(planned.margin)


@pytest.fixture(scope="module")
def inside(problem):
    """Return a solution of `problem` with the default margin, and its report."""
    return with_margin_of(problem, Budget(iterations=20_000), exact_clearance=True)


def test_library_and_command_have_one_default_margin():
    assert Request().margin == MARGIN["--margin"]["default"]


def test_the_log_of_a_plan_has_the_time_of_its_goals(problem, caplog):
    goals = goals_of(problem)
    with caplog.at_level("INFO", logger="cvqmpt"):
        solve(problem, "birrt", Budget(iterations=1), 0, goals=replace(goals, seconds=0.0345))
    assert "goals in 34.5 ms" in caplog.text


def test_the_margin_asked_for_is_kept_and_tolerated(inside):
    solution, text = inside
    assert solution.solved and text == "2 mm, 0.005 rad"
    assert solution.certificate.obstacle_clearance.at_least_m >= 0.002
    assert solution.certificate.tolerated.points_m >= 0.0019
    assert solution.certificate.tolerated.hand_rad >= 0.003


def test_joints_that_are_off_by_what_is_tolerated_neither_collide_nor_break_a_bound(
    problem, inside
):
    rng = np.random.default_rng(0)
    off = inside[0].certificate.tolerated.joints
    states = inside[0].path.states
    picked = states[rng.integers(len(states), size=300)]
    signs = np.sign(rng.standard_normal(picked.shape))
    checker = problem.collision_checker()
    assert off > 1e-4
    assert not any(checker.in_collision(q) for q in picked + off * signs)
    for region in problem.constraint:
        assert excess(region, displacements(problem.robot, region, picked + off * signs)).max() < 0


def test_no_turn_of_the_hand_within_the_slack_breaks_a_bound(problem, inside):
    rng = np.random.default_rng(0)
    states = inside[0].path.states
    turned, moved = least_slack(problem.robot, problem.constraint, states, 0.02)
    assert 0.003 < turned < 0.1 and moved == np.inf
    (region,) = problem.constraint
    for q in states[rng.integers(len(states), size=50)]:
        axis, turn = rng.standard_normal(3), np.eye(4)
        turn[:3, :3] = rotation_matrices(axis[None] / np.linalg.norm(axis) * turned)[0]
        # a hand rotated by R is equivalent to a region rotated by the inverse of R
        other = region.changed(Tw_e=turn @ region.Tw_e)
        assert excess(other, displacements(problem.robot, other, q[None])).max() <= 1e-9


def test_a_start_that_is_closer_lowers_the_margin_and_is_named(problem):
    inner, used, why = with_margin(problem, problem.goals, Margin(metres=0.09))
    room = problem.collision_checker().nearest_obstacle(problem.start).distance
    assert (
        inner.clearance == used.metres < min(room, 0.09) and "start is" in why and "mm from" in why
    )


@pytest.fixture(scope="module")
def beside_a_ball(panda):
    """A problem in free space, but for a ball that is 0.8 mm from the hand at the start."""
    start = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
    centre, near, far = panda.pose(start)[:3, 3] + (0.0, 0.0, 0.02), -0.02, -0.25

    def beside(y):
        ball = SceneObject("ball", Sphere(0.02), pose(centre + (0.0, y, 0.0)))
        scene, goal = Scene("ball", (ball,)), start + 0.2 * np.eye(7)[:1]
        return PlanningProblem("beside", panda, scene, start, goal)

    for _ in range(30):
        middle = 0.5 * (near + far)
        distance = beside(middle).collision_checker().nearest_obstacle(start).distance
        near, far = (near, middle) if distance > 8e-4 else (middle, far)
    return beside(far)


def test_a_moving_start_that_is_closer_lowers_the_margin_too(beside_a_ball, tmp_path, cvqmpt):
    """The search begins where the arm can stop, further away from the ball."""
    beside_a_ball.save(tmp_path / "p.json")
    words = [tmp_path / "p.json", "--planner", "birrt", "--iterations", 2000]
    told = cvqmpt(
        "plan", *words, "--trajectory", tmp_path / "m.json", "--start-velocity", "0.2 0 0 0 0 0 0"
    )
    margin = "margin      0.7 mm, 0.005 rad of 2 mm, 0.005 rad: the start is 0.7 mm from panda_"
    assert margin in told


def test_straight_ends_keep_what_the_whole_path_keeps(beside_a_ball):
    """Both ends are away from the ball, but the path between them goes to it and back."""
    aside = np.abs(np.linspace(-0.1, 0.1, 9))[:, None] * np.eye(7)[0]
    states = beside_a_ball.start + aside
    passing = beside_a_ball.changed(start=states[0], goals=states[-1:])
    kept = kept_by(passing, JointPath(states), Kept(Margin(), Margin()))
    assert str(kept) == "0 mm, 0.005 rad of 2 mm, 0.005 rad: its straight ends keep no more"
    away = passing.changed(scene=Scene("empty", ()))
    assert str(kept_by(away, JointPath(states), Kept(Margin(), Margin()))) == "2 mm, 0.005 rad"
    inner = Kept(Margin(0.001, 0.005), Margin(), "the start is 1.0 mm from a wall")
    told = str(kept_by(away, JointPath(states), inner))
    why = "between its straight ends: the start is 1.0 mm from a wall"
    assert told == f"1 mm, 0.005 rad of 2 mm, 0.005 rad: {why}"


def test_without_a_path_inside_it_is_planned_without(problem):
    # one iteration finds no path, with a margin or without; the second run has no margin
    solution, text = with_margin_of(problem, Budget(iterations=2), 0, Margin())
    assert text.startswith("none of 2 mm, 0.005 rad: no path with this margin")
    assert solution.problem.clearance == problem.clearance


def test_no_margin_is_the_plain_solution(problem, solution):
    again, text = with_margin_of(problem, Budget(iterations=20_000), 0, NO_MARGIN)
    assert text == "none requested"
    assert np.array_equal(again.path.states, solution.path.states)


def test_the_status_of_a_path_that_is_refused_is_the_verdict(problem, solution):
    straight = JointPath(np.linspace(problem.start, solution.path.states[-1], 50))
    refused = replace(solution, certificate=certify(problem, straight))
    said = refused.report().lines
    assert "status      refused by the certificate" in said and refused.status == "refused"
    assert any(line.startswith("certificate not certified: ") for line in said)


def test_phases_of_a_task_keep_what_their_start_and_goals_allow(task):
    solved = solve_task(task, "birrt", Budget(seconds=20.0), 0, margin=Margin())
    assert solved.solved
    assert all("mm" in outcome.margin for outcome in solved.outcomes)


def test_goals_are_left_out_with_the_bounds_of_the_problem(tmp_path):
    """A bound of 0.3 rad was stated as 0.295 rad, of which the margin was taken off."""
    states = np.array([[0.0, 0.0], [0.5, 0.1]])
    bound = {"fixed-orientation": {"rpy": [0.0, 0.0, 0.0], "tolerance": 0.3}}
    problem = problem_of(tmp_path, gantry(), states, ("wrist",), constraint=[bound])
    goals = np.array([[0.5, 0.1], [0.5, 0.298], [0.5, 0.5]])
    found, kept = with_margin_of(problem.changed(goals=goals), Budget(iterations=100))
    near, outside = found.left_out
    assert found.solved and kept == "2 mm, 0.005 rad"
    assert near == "goal 1 keeps less than the margin, 2 mm, 0.005 rad"
    assert outside.startswith("goal 2 breaks `fixed-orientation` by 0.2 rad")
    assert "0.5 of 0.3 rad" in outside


def test_the_margin_names_functions_to_which_none_is_kept(tmp_path):
    states = np.array([[0.0, 0.0], [0.5, 0.1]])
    bound = {"joint-coupling": {"factors": {"left_turn": 1.0}, "lower": -1.0, "upper": 0.3}}
    problem = problem_of(tmp_path, gantry(), states, ("wrist",), constraint=[bound])
    found, kept = with_margin_of(problem, Budget(iterations=100), 0)
    assert found.solved
    assert kept == "2 mm, 0.005 rad; none to the bounds of left_turn from -1 to 0.3"
