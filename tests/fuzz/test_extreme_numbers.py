"""With extreme numbers every plan ends within its budget, with a certified path or a reason."""

import time
from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import panda
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Sphere
from cvqmpt_lab.search.result import Budget, PlanStatus

LONGEST = 10.0  # [s] of processor time of a plan, all its stages included
READY = np.array([0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8])
BOTH, STEPS = ("birrt", "roadmap-cvq"), Budget(iterations=3000)
EMPTY = Scene("empty", ())
TINIEST = 5e-324
ENDED = (PlanStatus.TIMEOUT, PlanStatus.ITERATION_LIMIT)
ANY = ("birrt", "guided-birrt", "cvq-mpt", "roadmap-cvq", "mpnet")  # plan without a constraint too


def between(rng, scene=EMPTY, spread=0.5):
    """Return a problem from a free configuration to a near one."""
    robot = panda()
    checker = PlanningProblem("extreme", robot, scene, READY, READY[None]).collision_checker(1e-3)
    drawn = np.clip(READY + rng.uniform(-spread, spread, (200, 7)), robot.lower, robot.upper)
    start, goal = drawn[~checker.in_collision_batch(drawn)][:2]
    return PlanningProblem("extreme", robot, scene, start, goal[None])


def singular(rng):
    """Return a problem at a singularity: wrist above axis 1, elbow straight, two axes aligned."""
    problem = between(rng)
    start = problem.start.copy()
    start[[0, 1, 2, 4]] = rng.choice([0.0, 0.5]), 0.0, 0.0, 0.0
    start[3] = problem.robot.upper[3] if rng.random() < 0.5 else -1.5
    return replace(problem, start=start)


def at_limits(rng):
    """Return a problem with the last joints at both of their limits."""
    problem = between(rng)
    start, goal = problem.start.copy(), problem.goals.copy()
    for j in (4, 6):
        start[j], goal[0, j] = rng.permutation([problem.robot.lower[j], problem.robot.upper[j]])
    return replace(problem, start=start, goals=goal)


def already_there(rng):
    """Return a problem with the start as a goal, alone or with other goals."""
    problem = between(rng)
    others = problem.goals if rng.random() < 0.5 else problem.goals[:0]
    return problem.changed(goals=np.concatenate([others, problem.start[None]]))


def blocked(rng):
    """Return a problem without a solution: a peg beside the shoulder blocks joint 1."""
    peg = SceneObject("peg", Box((0.01, 0.01, 0.02)), pose((0.09, 0.0, 0.25)))
    problem = between(rng, Scene("blocked", (peg,)), spread=0.1)
    quarter = problem.robot.random_configurations(rng, 200)
    quarter[:, 0] = np.pi / 2
    assert problem.collision_checker().in_collision_batch(quarter).all()
    goal = problem.goals.copy()
    goal[:, 0] = 2.6
    return replace(problem, goals=goal)


def region(T, half_xy, half_z, half_angles):
    """Return a region with bounds around the pose T (4, 4)."""
    halves = np.array([half_xy, half_xy, half_z, *[half_angles] * 3])
    return TaskSpaceRegion(T, np.eye(4), np.stack([-halves, halves], axis=1))


def narrow(rng, width=0.0):
    """Return a problem that bounds the hand's height to a width [m], with a goal region there."""
    problem = between(rng)
    T = problem.robot.pose(problem.start)
    level, goals = region(T, FREE, width / 2, FREE), region(T, 0.15, 0.0, 0.3)
    return replace(problem, constraint=(level,), goals=problem.goals[:0], goal_region=goals)


def crowded(rng, count, size, far):
    """Return a problem among boxes and balls of one size [m], `far` to `far` + 1 [m] away."""
    objects = []
    for k in range(count):
        direction = rng.standard_normal(3)
        shape = Box((size, size, size)) if k % 2 else Sphere(size / 2)
        inside = size / 2 * (np.sqrt(3.0) if k % 2 else 1.0)
        at = direction / np.linalg.norm(direction) * (far + inside + rng.uniform(0.0, 1.0))
        objects.append(SceneObject(f"o{k}", shape, pose(at, rng.uniform(-3.0, 3.0))))
    return between(rng, Scene("crowded", tuple(objects)))


def denormal(rng):
    """Return a problem with denormal numbers in start, goal, bounds and poses."""
    problem = between(rng)
    start, goal = problem.start.copy(), problem.goals.copy()
    start[rng.integers(0, 3)] = TINIEST * rng.choice([-1.0, 1.0])
    goal[0, 0] += TINIEST
    ball = SceneObject("ball", Sphere(0.05), pose((1.5, TINIEST, -1e-310)))
    made = replace(problem, start=start, scene=Scene("tiny", (ball,)))
    if rng.random() < 0.5:
        return made
    T, width = problem.robot.pose(start), rng.choice([TINIEST, 1e-310, 1e-200])
    plane, near = region(T, FREE, width, FREE), region(T, 0.1, TINIEST, 0.3)
    return replace(made, constraint=(plane,), goals=goal[:0], goal_region=near)


def extreme(what, make, solved, planners=("birrt",), budget=STEPS, ci=1, long=100):
    """solved: whether a path exists; None where either is possible."""
    words = "extreme numbers end in a certified path or in no path, within the budget"
    mark = pytest.mark.promise(words, "plans", ci=ci, long=long)
    return pytest.param(make, solved, planners, budget, marks=mark, id=what)


CASES = [
    extreme("singular configurations", singular, True, ci=4, long=200),
    extreme("joints at their limits", at_limits, True, ci=4, long=200),
    extreme("the start is a goal", already_there, True, ANY, ci=5, long=200),
    extreme("nothing in the scene", between, True, ANY, ci=5, long=200),
    extreme("no way out", blocked, False, BOTH, Budget(seconds=0.5), ci=2, long=20),
    extreme("regions of no width", narrow, True, ci=2),
    extreme("regions of 0.2 mm", lambda rng: narrow(rng, 2e-4), True, ci=2),
    extreme("10 000 obstacles", lambda rng: crowded(rng, 10_000, 0.02, 0.9), None, long=5),
    extreme("obstacles of 0.1 mm", lambda rng: crowded(rng, 200, 1e-4, 0.4), None, ci=2),
    extreme("obstacles of 100 m", lambda rng: crowded(rng, 6, 100.0, 0.7), None, ci=2),
    extreme("denormal numbers", denormal, True, ci=4, long=200),
]


@pytest.mark.parametrize(("make", "solved", "planners", "budget"), CASES)
def test_plans(make, solved, planners, budget, trials):
    for seed in range(trials):
        planner = planners[seed % len(planners)]
        began = time.process_time()
        solution = solve(make(np.random.default_rng(seed)), planner, budget, seed)
        assert time.process_time() - began < LONGEST, (seed, planner)
        plan = solution.plan
        if plan.path is None:
            assert not solved and plan.status in ENDED, (seed, planner)
            assert plan.seconds < (budget.seconds or np.inf) + 1.0, (seed, planner)
        else:
            found = solution.certificate
            assert found.valid and solved is not False, (seed, planner, found)
