"""Many problems at once, and time left for a better path."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.certificate import certify
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.pipeline import NEAR_GOALS, solve, solve_many, with_sampled_goals
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import ConvexMesh, Cylinder, PointCloud, Sphere
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.tasks.solve import solve_task

ENOUGH = Budget(iterations=20_000)


def test_many_problems_are_solved_as_each_alone_in_the_order_given(problem):
    other = place_problem(1)
    problems = [problem, other, problem.changed(goals=problem.goals[:3])]
    found = solve_many(problems, "birrt", ENOUGH, seed=1, clearance=False)
    assert [solution.problem.name for solution in found] == [given.name for given in problems]
    for given, solution in zip(problems, found, strict=True):
        alone = solve(given, "birrt", ENOUGH, seed=1, clearance=False)
        assert solution.solved and solution.plan.counters == alone.plan.counters
        np.testing.assert_array_equal(solution.simplified.path.states, alone.simplified.path.states)
    assert solve_many([], "birrt", ENOUGH) == []


@pytest.mark.parametrize("planner", ["birrt", "roadmap-cvq"])
def test_iterations_left_make_the_path_shorter_and_repeat(problem, planner):
    plain = solve(problem, planner, ENOUGH, seed=3, clearance=False)
    how = {"seed": 3, "clearance": False, "optimize": Budget(iterations=60)}
    better, again = (solve(problem, planner, ENOUGH, **how) for _ in range(2))
    np.testing.assert_array_equal(better.simplified.path.states, again.simplified.path.states)
    made = better.improvement
    lengths = [length for _, length in made.lengths]
    assert lengths[0] == plain.simplified.path.length
    assert lengths[-1] == better.simplified.path.length
    assert lengths[-1] < lengths[0] and lengths == sorted(lengths, reverse=True)
    assert made.gained == pytest.approx(1.0 - lengths[-1] / lengths[0]) and made.iterations >= 60
    assert better.plan.counters == plain.plan.counters
    assert better.solved and certify(problem, better.simplified.path).valid


def test_seconds_left_are_used_and_hardly_more(problem):
    how = {"seed": 3, "clearance": False, "optimize": Budget(seconds=0.2)}
    made = solve(problem, "birrt", Budget(seconds=60.0), **how).improvement
    assert 0.2 <= made.seconds < 1.0


@pytest.mark.parametrize("backend", ["compiled", "exact"])
def test_a_clearance_is_planned_for_and_certified(problem, backend):
    """To all kinds of shapes, not between links; a path planned without it is refused."""
    shapes = Sphere(0.03), Cylinder(0.02, 0.1), PointCloud(np.zeros((1, 3)), 0.02)
    shapes += (ConvexMesh(np.eye(4, 3) * 0.1),)
    placed = [(shape, pose((0.6, 0.2 * k - 0.3, 0.75))) for k, shape in enumerate(shapes)]
    more = [SceneObject(f"more {k}", *each) for k, each in enumerate(placed)]
    world = replace(problem, scene=problem.scene.with_objects(*more), goals=problem.goals[:0])
    plain = solve(world, "birrt", ENOUGH, seed=0, backend=backend)
    clear = solve(replace(world, clearance=0.02), "birrt", ENOUGH, seed=0, backend=backend)
    assert plain.solved and plain.certificate.min_clearance_m < 0.02 and clear.solved
    refused = certify(replace(world, clearance=0.02), plain.simplified.path)
    assert any("closer than the clearance of 20 mm" in reason for reason in refused.reasons)
    robot = replace(
        problem.robot, self_collision_pairs=(), collision_model=without_pairs(problem.robot)
    )
    alone = CollisionChecker(robot, world.scene)
    assert all(alone.nearest(q).distance >= 0.02 for q in clear.simplified.path.states)
    space = ConstrainedSpace(replace(world, clearance=0.02))
    states = problem.robot.random_configurations(np.random.default_rng(0), 2000)
    free = states[space.valid_batch(states)]
    assert len(free) > 50 and not space.problem.collision_checker().in_collision_batch(free).any()


def without_pairs(robot):
    geometry = robot.collision_model.copy()
    geometry.removeAllCollisionPairs()
    return geometry


def test_near_goals_are_tried_first_where_joints_turn_more_than_once():
    """Goals of a UR5 that were full turns away made paths longer."""
    robot = robot_from_source({"name": "ur5"})
    start = np.array([0.0, -1.5, 1.0, -1.0, -1.5, 0.0])
    near = [start + 0.6 + 0.01 * k for k in range(NEAR_GOALS)]
    far = [start + [0.6 + 2 * np.pi * (-1) ** k * 0.9, 0, 0, 0, 0, 0.01 * k] for k in range(10)]
    problem = PlanningProblem("turns", robot, Scene("empty", ()), start, np.array([*far, *near]))
    for seed in range(5):
        states = solve(problem, "birrt", ENOUGH, seed, near_goals_first=True).simplified.path.states
        assert np.abs(problem.goals[10:] - states[-1]).max(axis=1).min() < 1e-9


def test_a_run_without_a_clock_takes_no_seconds(problem):
    refused(
        r"optimize: 0\.05 s in a run of 20000 iterations",
        solve,
        problem,
        "birrt",
        ENOUGH,
        seed=0,
        optimize=Budget(seconds=0.05),
    )


@pytest.mark.parametrize(
    ("number", "planner", "backend"), [(0, "birrt", "exact"), (1, "ompl-projected", "compiled")]
)
def test_four_threads_find_the_paths_and_verdicts_of_one(four_threads, number, planner, backend):
    problem, _ = with_sampled_goals(place_problem(number))

    def planned(seed):
        how = {"backend": backend, "clearance": False}
        return solve(problem, planner, ENOUGH, seed, **how).simplified.path

    alone = [planned(seed) for seed in range(3)]
    together = four_threads(planned, 2 * [0, 1, 2])
    for path, same in zip(together, 2 * alone, strict=True):
        np.testing.assert_array_equal(path.states, same.states)
    assert all(four_threads(lambda path: certify(problem, path).valid, together))


@pytest.mark.parametrize("seed", [-1, 2.5, np.nan, "3", None, True, [1]])
@pytest.mark.parametrize("call", [solve, solve_task, solve_many])
def test_a_seed_that_is_no_whole_number_is_refused(problem, task, call, seed):
    given = {solve: problem, solve_task: task, solve_many: [problem]}[call]
    refused(r"seed .*: give a whole number of 0 or more", call, given, "birrt", ENOUGH, seed)


def test_objects_of_a_wrong_type_are_refused_by_their_type(problem, task):
    loads = r"it must be a PlanningProblem: PlanningProblem\.load"
    for call, given, told in (
        (solve, ("mine.json", "birrt"), f"problem is a str, 'mine.json'; {loads}"),
        (solve, (task, "birrt"), "problem is a Task, .*; a Task is for solve_task"),
        (solve, (problem, 3), "method is a int, 3; it must be a Method: or the name of a planner"),
        (solve_many, (problem, "birrt"), "problems is a PlanningProblem, .*a list of problems"),
        (solve_many, ([problem, None], "birrt"), rf"problems\[1\] is a NoneType, None; {loads}"),
        (solve_task, (problem, "birrt"), "task is a PlanningProblem, .*a Task: .*for solve"),
        (solve_task, (task, None), "method is a NoneType"),
    ):
        refused(told, call, *given, ENOUGH, 0)


@pytest.mark.parametrize("budget", [2.5, None, "3", {"iterations": 3}])
def test_what_is_no_budget_is_refused(problem, task, budget):
    for call, given in ((solve, problem), (solve_task, task)):
        refused(r"budget .*: give Budget\(seconds=\.\.\.\)", call, given, "birrt", budget, 0)
    if budget is not None:
        refused(r"optimize .*: give Budget", solve, problem, "birrt", ENOUGH, 0, optimize=budget)


@pytest.mark.parametrize(
    ("field", "values", "must"),
    [
        (
            "iterations",
            [2.5, np.nan, "3", 0, -1, 1e300, np.inf, True, [1], 2**70],
            "whole number from 1",
        ),
        ("seconds", [np.nan, "3", 0, -1, [1]], "number above 0"),
    ],
)
def test_a_budget_of_nothing_is_refused(field, values, must):
    for value in values:
        refused(f"budget {field} .*: give a {must}", Budget, **{field: value})
    refused("budget needs", Budget)
