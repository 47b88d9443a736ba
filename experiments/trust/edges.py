"""Where numbers are at their edge: every plan ends within its budget, in a certified path or a reason."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion
from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.pipeline import Solution, solve
from cvqmpt_lab.planning.result import Budget, PlanStatus
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Sphere
from experiments.trust.check import Check, Trial

Rng = np.random.Generator
Made = Callable[[Rng], PlanningProblem]
ENOUGH, SECOND = Budget(iterations=3000), Budget(seconds=1.0)
LONGEST = 10.0
"""[s] of processor time that a plan may take, arrays of 10 000 obstacles, goals, shortening and proof included."""
READY = np.array([0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8])
EMPTY = Scene("empty", ())
TINIEST = 5e-324


@dataclass(frozen=True)
class Edge:
    """Problems of one kind."""

    make: Made
    """Draws one."""
    solved: bool | None
    """Whether there is a path to be found, or None where either may be."""
    planners: tuple[str, ...] = ("birrt",)
    """Who plans."""
    budget: Budget = ENOUGH
    """When to give up."""


def between(
    rng: Rng, scene: Callable[[Rng], Scene] = lambda rng: EMPTY, spread: float = 0.5
) -> PlanningProblem:
    """From one free configuration to another near by, both drawn, as is the scene."""
    robot = panda()
    for _ in range(100):
        ends = np.clip(READY + rng.uniform(-spread, spread, (2, 7)), robot.lower, robot.upper)
        problem = PlanningProblem("edge", robot, scene(rng), ends[0], ends[1:])
        if not problem.collision_checker(1e-3).in_collision_batch(ends).any():
            return problem
    raise AssertionError("no free configuration in a hundred")


def singular(rng: Rng) -> PlanningProblem:
    """The wrist over the first axis, the elbow as straight as it goes, two axes in line."""
    problem = between(rng)
    start = problem.start.copy()
    start[[0, 1, 2, 4]] = rng.choice([0.0, 0.5]), 0.0, 0.0, 0.0
    start[3] = problem.robot.upper[3] if rng.random() < 0.5 else -1.5
    return replace(problem, start=start)


def at_a_limit(rng: Rng) -> PlanningProblem:
    """The last joints as far as they go, at both ends."""
    problem = between(rng)
    start, goal = problem.start.copy(), problem.goals.copy()
    for joint in (4, 6):
        start[joint], goal[0, joint] = rng.permutation(
            [problem.robot.lower[joint], problem.robot.upper[joint]]
        )
    return replace(problem, start=start, goals=goal)


def already_there(rng: Rng) -> PlanningProblem:
    """The goal is the start, among others or alone."""
    problem = between(rng)
    others = problem.goals if rng.random() < 0.5 else problem.goals[:0]
    return problem.with_goals(np.concatenate([others, problem.start[None]]))


def blocked(rng: Rng) -> PlanningProblem:
    """A peg beside the shoulder, which the first joint alone moves: a quarter turn hits it, however others stand."""
    peg = SceneObject("peg", Box((0.01, 0.01, 0.02)), pose((0.09, 0.0, 0.25)))
    problem = between(rng, lambda rng: Scene("blocked", (peg,)), spread=0.1)
    quarter = problem.robot.random_configurations(rng, 200)
    quarter[:, 0] = np.pi / 2
    assert problem.collision_checker().in_collision_batch(quarter).all()
    goal = problem.goals.copy()
    goal[:, 0] = 2.6
    return replace(problem, goals=goal)


def narrow(width: float, rng: Rng) -> PlanningProblem:
    """The hand keeps its height to within a width [m]; goals are drawn from a region of the same height."""
    problem = between(rng)
    T = problem.robot.pose(problem.start)
    Bw = np.array([[-FREE, FREE]] * 2 + [[-width / 2, width / 2]] + [[-FREE, FREE]] * 3)
    plane = TaskSpaceRegion(T, np.eye(4), Bw)
    near = np.array([[-0.15, 0.15]] * 2 + [[0.0, 0.0]] + [[-0.3, 0.3]] * 3)
    region = TaskSpaceRegion(T, np.eye(4), near)
    return replace(problem, constraint=(plane,), goals=problem.goals[:0], goal_region=region)


def crowd(count: int, size: float, far: float, rng: Rng) -> Scene:
    """So many boxes and balls of one size [m], `far` [m] and up to 1 m more from the base."""
    objects = []
    for k in range(count):
        direction = rng.standard_normal(3)
        shape = Box((size, size, size)) if k % 2 else Sphere(size / 2)
        inside = size / 2 * (np.sqrt(3.0) if k % 2 else 1.0)
        at = direction / np.linalg.norm(direction) * (far + inside + rng.uniform(0.0, 1.0))
        objects.append(SceneObject(f"o{k}", shape, pose(at, rng.uniform(-3.0, 3.0))))
    return Scene("crowded", tuple(objects))


def crowded(count: int, size: float, far: float, rng: Rng) -> PlanningProblem:
    """Among the obstacles of `crowd`."""
    return between(rng, partial(crowd, count, size, far))


def denormal(rng: Rng) -> PlanningProblem:
    """Numbers next to nothing: of the start, of bounds, of places."""
    problem = between(rng)
    start = problem.start.copy()
    start[rng.integers(0, 3)] = TINIEST * rng.choice([-1.0, 1.0])
    T = problem.robot.pose(start)
    width = rng.choice([TINIEST, 1e-310, 1e-200])
    Bw = np.array([[-FREE, FREE]] * 2 + [[-width, width]] + [[-FREE, FREE]] * 3)
    plane = TaskSpaceRegion(T, np.eye(4), Bw)
    ball = SceneObject("ball", Sphere(0.05), pose((1.5, TINIEST, -1e-310)))
    goal = problem.goals[0].copy()
    goal[0] += TINIEST
    made = replace(problem, start=start, scene=Scene("tiny", (ball,)))
    if rng.random() < 0.5:
        return made
    near = np.array([[-0.1, 0.1]] * 2 + [[-TINIEST, TINIEST]] + [[-0.3, 0.3]] * 3)
    return replace(
        made, constraint=(plane,), goals=goal[None][:0], goal_region=TaskSpaceRegion(T, np.eye(4), near)
    )


def faults_of(edge: Edge, trials: int) -> Trial:
    """Plan on so many problems."""
    faults: list[str] = []
    for seed in range(trials):
        planner = edge.planners[seed % len(edge.planners)]
        began = time.process_time()
        try:
            solution = solve(
                edge.make(np.random.default_rng(seed)), planner, edge.budget, seed, clearance=False
            )
            fault = _fault(edge, solution)
        except CvqmptError as error:
            fault = f"refused: {error}"
        took = time.process_time() - began
        if not fault and took > LONGEST:
            fault = f"took {took:.1f} s"
        faults += [f"seed {seed}, {planner}: {fault}"] if fault else []
    return Trial(trials, faults)


def _fault(edge: Edge, solution: Solution) -> str:
    """What is wrong with how a plan ended, or ""."""
    plan = solution.plan
    if plan.path is None:
        gave_up = plan.status in (PlanStatus.TIMEOUT, PlanStatus.ITERATION_LIMIT)
        if edge.solved or not gave_up:
            return f"{plan.status} {plan.detail}"
        late = plan.seconds - (edge.budget.seconds or np.inf)
        return f"ended {late:.1f} s after its budget" if late > 1.0 else ""
    assert solution.certificate is not None
    if not solution.certificate.valid:
        return f"refused: {'; '.join(solution.certificate.reasons)}"
    return "a path was found where there is none" if edge.solved is False else ""


WITHOUT_CONSTRAINT = ("birrt", "guided-birrt", "cvq-mpt", "roadmap-cvq", "mpnet")
EDGES: dict[str, tuple[Edge, int, int]] = {
    "singular configurations": (Edge(singular, True), 4, 200),
    "joints at their limits": (Edge(at_a_limit, True), 4, 200),
    "the start is a goal": (Edge(already_there, True, WITHOUT_CONSTRAINT), 5, 200),
    "nothing in the scene": (Edge(between, True, WITHOUT_CONSTRAINT), 5, 200),
    "no way out": (Edge(blocked, False, ("birrt", "roadmap-cvq"), SECOND), 2, 20),
    "regions of no width": (Edge(partial(narrow, 0.0), True), 2, 100),
    "regions of 0.2 mm": (Edge(partial(narrow, 2e-4), True), 2, 100),
    "10 000 obstacles": (Edge(partial(crowded, 10_000, 0.02, 0.9), None), 1, 5),
    "obstacles of 0.1 mm": (Edge(partial(crowded, 200, 1e-4, 0.4), None), 2, 100),
    "obstacles of 100 m": (Edge(partial(crowded, 6, 100.0, 0.7), None), 2, 100),
    "denormal numbers": (Edge(denormal, True), 4, 200),
}
"""Problems, trials in the tests of every commit, and trials of the long form."""

CHECKS = tuple(
    Check(f"at an edge: {what}", "plans", short, long, partial(faults_of, edge))
    for what, (edge, short, long) in EDGES.items()
)
