"""Many problems at once, threads and processes, time left for a better path, wrong arguments."""

import multiprocessing
import os
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from threadpoolctl import threadpool_info, threadpool_limits

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.base.processes import end_with_parent, one_thread
from cvqmpt_lab.benchmarks.more_constraints import more_constraints_problem
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.collision import arrays
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.task_space_region import symmetric_region
from cvqmpt_lab.features.tasks.solve import solve_task
from cvqmpt_lab.planning.pipeline import NEAR_GOAL_COUNT, solve, solve_many, with_drawn_goals
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import ConvexMesh, Cylinder, PointCloud, Sphere
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import GaussianMixture, Uniform
from cvqmpt_lab.search.result import Budget, JointPath, PlanStatus
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.search.work import PRICES

ENOUGH = Budget(iterations=20_000)


def test_many_problems_are_solved_as_each_alone_in_the_order_given(problem):
    other = place_problem(1)
    problems = [problem, other, problem.changed(goals=problem.goals[:3])]
    found = solve_many(problems, "birrt", ENOUGH, seed=1)
    assert [solution.problem.name for solution in found] == [given.name for given in problems]
    for given, solution in zip(problems, found, strict=True):
        alone = solve(given, "birrt", ENOUGH, seed=1)
        assert solution.solved and solution.plan.counters == alone.plan.counters
        np.testing.assert_array_equal(solution.path.states, alone.path.states)
    assert solve_many([], "birrt", ENOUGH) == []


def test_a_run_asks_for_the_arrays_of_its_scene_once(monkeypatch):
    scenes, make = [], arrays.scene_arrays
    monkeypatch.setattr(arrays, "scene_arrays", lambda *one: scenes.append(one[0]) or make(*one))
    without_goals = place_problem(0)
    assert len(without_goals.goals) == 0
    found = solve(without_goals, "birrt", ENOUGH, seed=0, optimize=Budget(iterations=5))
    assert found.solved and scenes == [without_goals.scene]


@pytest.mark.parametrize("planner", ["birrt", "roadmap-cvq"])
def test_iterations_left_make_the_path_shorter_and_repeat(problem, planner):
    plain = solve(problem, planner, ENOUGH, seed=3)
    how = {"seed": 3, "optimize": Budget(iterations=60)}
    better, again = (solve(problem, planner, ENOUGH, **how) for _ in range(2))
    np.testing.assert_array_equal(better.path.states, again.path.states)
    made = better.improvement
    lengths = [length for _, length in made.lengths]
    assert lengths[0] == plain.path.length
    assert lengths[-1] == better.path.length
    assert lengths[-1] < lengths[0] and lengths == sorted(lengths, reverse=True)
    assert made.gained == pytest.approx(1.0 - lengths[-1] / lengths[0]) and made.iterations >= 60
    assert better.plan.counters == plain.plan.counters
    assert better.solved and certify(problem, better.path).valid


class Careless:
    """A search whose first path is the straight line to a goal, even through obstacles."""

    def __init__(self):
        self.calls = 0

    def search(self, query, distribution):
        """Return the straight line at first, then what `BiRRT` finds."""
        self.calls += 1
        found = BiRRT().search(query, distribution)
        line = JointPath(np.linspace(query.start, query.goals[0], 200))
        return replace(found, status=PlanStatus.SOLVED, path=line) if self.calls == 1 else found


@pytest.mark.parametrize("iterations, solved", [(20_000, True), (1, False)])
def test_the_search_goes_on_after_a_path_that_is_refused(problem, iterations, solved):
    careless = Careless()
    method = Method.simple("careless", search=careless)
    found = solve(problem, method, Budget(iterations=iterations), seed=0)
    assert found.solved == solved == (careless.calls == 2)
    assert found.plan.status == "solved" and found.certificate.valid == solved


def test_seconds_left_are_used_and_hardly_more(problem):
    how = {"seed": 3, "optimize": Budget(seconds=0.2)}
    made = solve(problem, "birrt", Budget(seconds=60.0), **how).improvement
    assert 0.2 <= made.seconds < 1.0


@pytest.mark.parametrize("backend", ["compiled", "exact"])
def test_a_clearance_is_planned_for_and_certified(problem, backend):
    """It holds for all shapes, not between links; a path planned without it is refused."""
    shapes = Sphere(0.03), Cylinder(0.02, 0.1), PointCloud(np.zeros((1, 3)), 0.02)
    shapes += (ConvexMesh(np.eye(4, 3) * 0.1),)
    placed = [(shape, pose((0.6, 0.2 * k - 0.3, 0.75))) for k, shape in enumerate(shapes)]
    more = [SceneObject(f"more {k}", *each) for k, each in enumerate(placed)]
    world = replace(problem, scene=problem.scene.with_objects(*more), goals=problem.goals[:0])
    plain = solve(world, "birrt", ENOUGH, seed=0, backend=backend, exact_clearance=True)
    clear = solve(replace(world, clearance=0.02), "birrt", ENOUGH, seed=0, backend=backend)
    assert plain.solved and plain.certificate.min_clearance_m < 0.02 and clear.solved
    near = certify(replace(world, clearance=0.02), plain.path)
    assert any("closer than the clearance of 20 mm" in reason for reason in near.reasons)
    geometry = problem.robot.collision_model.copy()
    geometry.removeAllCollisionPairs()
    robot = replace(problem.robot, self_collision_pairs=(), collision_model=geometry)
    alone = CollisionChecker(robot, world.scene)
    assert all(alone.nearest(q).distance >= 0.02 for q in clear.path.states)
    kept = replace(world, clearance=0.02)
    space = ConstrainedSpace.of(kept)
    states = problem.robot.random_configurations(np.random.default_rng(0), 2000)
    free = states[space.valid_batch(states)]
    assert len(free) > 50 and not kept.collision_checker().in_collision_batch(free).any()


def test_near_goals_are_tried_first_where_joints_turn_more_than_once():
    """Goals of a UR5 at full turns from the start formerly made paths longer."""
    robot = robot_from_source({"name": "ur5"})
    start = np.array([0.0, -1.5, 1.0, -1.0, -1.5, 0.0])
    near = [start + 0.6 + 0.01 * k for k in range(NEAR_GOAL_COUNT)]
    far = [start + [0.6 + 2 * np.pi * (-1) ** k * 0.9, 0, 0, 0, 0, 0.01 * k] for k in range(10)]
    problem = PlanningProblem("turns", robot, Scene("empty", ()), start, np.array([*far, *near]))
    for seed in range(5):
        states = solve(problem, "birrt", ENOUGH, seed, near_goals_first=True).path.states
        assert np.abs(problem.goals[10:] - states[-1]).max(axis=1).min() < 1e-9


@pytest.mark.parametrize("given", [False, True])
def test_a_goal_near_the_start_is_searched_before_goals_at_other_turns(given):
    """An xArm7 formerly moved 4 rad to a goal 1 cm above; given goals were searched all at once."""
    robot = robot_from_source({"name": "xarm7"})
    start = np.array([0.0, 0.3, 0.0, 1.2, 0.0, 0.9, 0.0])
    above = robot.pose(start) + [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0.01], [0, 0, 0, 0]]
    region = symmetric_region(above, np.eye(4), [0.0] * 6)
    problem = PlanningProblem("near", robot, Scene("e", ()), start, goal_region=region)
    if given:
        drawn = with_drawn_goals(problem).goals
        problem = PlanningProblem("near", robot, Scene("e", ()), start, drawn[::-1])
    for seed in range(3):
        found = solve(problem, "roadmap", ENOUGH, seed, near_goals_first=True)
        assert found.path.length < 0.1


@pytest.mark.parametrize(
    ("number", "planner", "backend"), [(0, "birrt", "exact"), (1, "ompl-projected", "compiled")]
)
def test_four_threads_find_the_paths_and_verdicts_of_one(four_threads, number, planner, backend):
    problem = with_drawn_goals(place_problem(number))

    def planned(seed):
        return solve(problem, planner, ENOUGH, seed, backend=backend).path

    alone = [planned(seed) for seed in range(3)]
    together = four_threads(planned, 2 * [0, 1, 2])
    for path, same in zip(together, 2 * alone, strict=True):
        np.testing.assert_array_equal(path.states, same.states)
    assert all(four_threads(lambda path: certify(problem, path).valid, together))


@pytest.mark.parametrize(("off", "code"), [(0, 0), (1, 1)])
def test_a_worker_whose_parent_is_another_by_now_ends_at_once(off, code):
    worker = multiprocessing.get_context("fork").Process(
        target=end_with_parent, args=(os.getpid() + off,)
    )
    worker.start()
    worker.join(20)
    assert worker.exitcode == code


def test_libraries_have_one_thread_meanwhile_and_a_learned_path_is_the_same_on_four(problem):
    with threadpool_limits(3):
        before = threadpool_info()
        with one_thread():
            assert {library["num_threads"] for library in threadpool_info()} == {1}
        assert threadpool_info() == before

    def states(threads):
        with threadpool_limits(threads):
            found = solve(problem, "mpnet-bridged", Budget(iterations=300), seed=0)
        return found.plan.path.states.tobytes()

    assert states(1) == states(4)


SEEDS = (-1, 2.5, np.nan, "3", None, True, [1])
BUDGETS = (2.5, None, "3", {"iterations": 3})
ITERATIONS = (2.5, np.nan, "3", 0, -1, 1e300, np.inf, True, [1], 2**70)
LOADS = r"it must be a PlanningProblem: PlanningProblem\.load"


def test_arguments_of_a_wrong_type_are_refused_by_their_type(problem, task):
    for call, given, told in (
        (solve, ("mine.json", "birrt"), f"problem is a str, 'mine.json'; {LOADS}"),
        (solve, (task, "birrt"), "problem is a Task, .*; a Task is for solve_task"),
        (solve, (problem, 3), "method is a int, 3; it must be a Method: or the name of a planner"),
        (solve_many, (problem, "birrt"), "problems is a PlanningProblem, .*a list of problems"),
        (solve_many, ([problem, None], "birrt"), rf"problems\[1\] is a NoneType, None; {LOADS}"),
        (solve_task, (problem, "birrt"), "task is a PlanningProblem, .*a Task: .*for solve"),
        (solve_task, (task, None), "method is a NoneType"),
    ):
        refused(told, call, *given, ENOUGH, 0)
    for call, given in ((solve, problem), (solve_task, task), (solve_many, [problem])):
        for seed in SEEDS:
            told = "seed .*: give a whole number of 0 or more"
            refused(told, call, given, "birrt", ENOUGH, seed)
    told = r"{} .*: give Budget\(seconds=\.\.\.\)"
    for budget in BUDGETS:
        for call, given in ((solve, problem), (solve_task, task)):
            refused(told.format("budget"), call, given, "birrt", budget, 0)
        if budget is not None:
            how = {"seed": 0, "optimize": budget}
            refused(told.format("optimize"), solve, problem, "birrt", ENOUGH, **how)


def test_a_budget_of_nothing_is_refused():
    for iterations in ITERATIONS:
        told = "budget iterations .*: give a whole number from 1"
        refused(told, Budget, iterations=iterations)
    for seconds in (np.nan, "3", 0, -1, [1]):
        refused("budget seconds .*: give a number above 0", Budget, seconds=seconds)
    refused("budget needs", Budget)


LIMITS = Uniform(np.array([-1.0, 2.0]), np.array([1.0, 5.0]))
MEANS = np.array([[0.0, 0.0], [10.0, -10.0]])
COVARIANCES = np.array([[[0.04, 0.03], [0.03, 0.09]], [[1.0, -0.5], [-0.5, 0.5]]])
GOOD = {"means": MEANS, "covariances": COVARIANCES, "weights": np.array([0.3, 0.7])}


@pytest.mark.parametrize(
    ("changes", "pattern"),
    [
        ({"covariances": COVARIANCES[:1]}, r"covariances \(1, 2, 2\)"),
        ({"weights": np.ones(3) / 3}, r"weights \(3,\)"),
        ({"weights": np.array([0.3, 0.3])}, "sum to 1, not 0.6"),
        ({"weights": np.array([1.5, -0.5])}, "non-negative"),
        ({"weights": np.array([np.nan, 1.0])}, "sum to 1, not nan"),
        ({"uniform_share": 0.1}, "0.1: give 0 to 1, with a uniform distribution"),
        ({"uniform_share": 1.2, "uniform": LIMITS}, "1.2: give 0 to 1"),
        ({"uniform_share": np.nan, "uniform": LIMITS}, "nan: give 0 to 1"),
        ({"means": MEANS * np.nan}, "means"),
        ({"covariances": -COVARIANCES}, "covariance"),
    ],
)
def test_unusable_mixtures_are_refused(changes, pattern):
    refused(pattern, GaussianMixture, **GOOD | changes)


def test_a_single_goal_has_the_whole_budget():
    """Uniform samples in OMPL do not find this goal in the 2.5 s of one among several."""
    solution = solve(more_constraints_problem(40), "ompl-uniform", Budget(cost=4.0), seed=0)
    done = solution.plan.counters
    spent = PRICES["published"].cost(done.state_checks, done.projections, done.newton_iterations)
    assert spent > 4.0
