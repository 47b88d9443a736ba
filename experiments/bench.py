"""Benchmarks: what things cost on this machine. Never a test; ratios within one run are what to quote."""

import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.constraints.task_space_region import MAX_ITERATIONS, TOLERANCE, RegionConstraint, upright
from cvqmpt_lab.distributions import Uniform
from cvqmpt_lab.kernels.compiling import driver
from cvqmpt_lab.kernels.geometry import scene_geometry
from cvqmpt_lab.kernels.kinematics import forward_kinematics
from cvqmpt_lab.kernels.projection import project_batch, projection_scratch
from cvqmpt_lab.kernels.space import Space, state_valid
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planning.collision_arrays import cloud_specs, scene_specs
from cvqmpt_lab.planning.result import Budget, PlanStatus
from cvqmpt_lab.planning.simplify import SimplifySettings, simplify
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.planning.table import PLANNERS, planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene, SceneObject, pose
from cvqmpt_lab.scene.shapes import Box, PointCloud
from experiments.place_task import TUNING_ENVIRONMENTS, place_problem

REPEATS = 7
STATES = 20_000


class Figure(NamedTuple):
    """One measured figure: median, smallest and largest over repeats."""

    name: str
    median: float
    low: float
    high: float
    unit: str


def _timed(name: str, call: Callable[[], object], per: int, unit: str = "us") -> Figure:
    """Time a call REPEATS times after a first one; scale to one of `per` items."""
    call()
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    scale = {"us": 1e6, "ms": 1e3}[unit] / per
    return Figure(name, float(np.median(seconds)) * scale, min(seconds) * scale, max(seconds) * scale, unit)


@driver
def _states_valid(space, configurations, out):
    for i in range(configurations.shape[0]):
        out[i] = state_valid(space, configurations[i])


@driver
def _poses_of_all(kinematics, configurations, link_rotation, link_translation):
    for i in range(configurations.shape[0]):
        forward_kinematics(kinematics, configurations[i], link_rotation, link_translation)


@driver
def _calibration_loop(n):
    total = 0.0
    for i in range(n):
        total += np.sin(i * 1e-3)
    return total


def calibration_ns() -> float:
    """Nanoseconds per sine in a fixed compiled loop: compares machines and moments."""
    return _timed("", lambda: _calibration_loop(100_000), 100_000).median * 1e3


def bench_kernels(problems: int) -> list[Figure]:
    """Forward kinematics and projection, one configuration at a time."""
    problem = _tuning_problems(1)[0]
    robot, constraint = problem.robot, RegionConstraint(problem.robot, (upright(),))
    rng = np.random.default_rng(0)
    uniform = robot.random_configurations(rng, STATES)
    scratch = projection_scratch(robot.dof, constraint.dim)
    regions = constraint.regions()

    def project(configurations: np.ndarray) -> Callable[[], object]:
        return lambda: project_batch(
            robot.kinematics, regions, configurations.copy(), TOLERANCE, MAX_ITERATIONS, scratch
        )

    on_manifold = uniform.copy()
    project_batch(robot.kinematics, regions, on_manifold, TOLERANCE, MAX_ITERATIONS, scratch)
    near = on_manifold + rng.normal(0.0, 0.05 / np.sqrt(robot.dof), on_manifold.shape)
    poses = (np.zeros((robot.dof + 1, 3, 3)), np.zeros((robot.dof + 1, 3)))
    return [
        Figure("calibration: sine", *3 * (calibration_ns(),), "ns"),
        _timed("forward kinematics", lambda: _poses_of_all(robot.kinematics, uniform, *poses), STATES),
        _timed("projection, 0.05 rad off the manifold", project(near), STATES),
        _timed("projection, uniform sample", project(uniform), STATES),
    ]


def bench_collision(problems: int) -> list[Figure]:
    """State checks of either backend in the kitchen, and of the compiled one against obstacle count."""
    problem = _tuning_problems(1)[0]
    rng = np.random.default_rng(0)
    states = problem.robot.random_configurations(rng, STATES)
    space = ConstrainedSpace(problem)
    free = np.zeros(STATES, dtype=bool)
    _states_valid(space.arrays, states, free)
    exact = problem.collision_checker()
    some_free = states[free][:1000]
    figures = [
        _check_time("kitchen, all states", space.arrays, states),
        _check_time("kitchen, free states", space.arrays, states[free]),
        _timed("kitchen, free states, coal from Python", lambda: exact.in_collision_batch(some_free), 1000),
        *_agreement(problem, states[:4000], free[:4000]),
    ]
    for count in (10, 100, 1000, 10_000):
        figures += _crowded(problem, f"{count} boxes", _random_boxes(count, rng), space)
    for count in (10**3, 10**4, 10**5, 10**6):
        points = _shell_points(count, rng)
        figures += _crowded(
            problem, f"cloud of {count} points", cloud_specs(PointCloud(points, 0.005), np.eye(4)), space
        )
    return figures


def _check_time(name: str, arrays: Space, states: np.ndarray) -> Figure:
    out = np.zeros(len(states), dtype=bool)
    return _timed(f"state check: {name}", lambda: _states_valid(arrays, states, out), len(states))


def _agreement(problem: PlanningProblem, states: np.ndarray, compiled_free: np.ndarray) -> list[Figure]:
    """States in which the compiled checker and coal differ."""
    exact_free = ~problem.collision_checker().in_collision_batch(states)
    missed = int((compiled_free & ~exact_free).sum())
    extra = 100.0 * (~compiled_free & exact_free).sum() / max(exact_free.sum(), 1)
    return [
        Figure("collisions called free, of 4000 states", *3 * (float(missed),), "states"),
        Figure("free states called colliding", *3 * (float(extra),), "%"),
    ]


def _crowded(problem: PlanningProblem, name: str, specs: list, space: ConstrainedSpace) -> list[Figure]:
    """Building and checking against many obstacles."""
    reach = np.full(3, problem.robot.reach)
    began = time.perf_counter()
    geometry = scene_geometry(specs, -reach, reach)
    build = 1e3 * (time.perf_counter() - began)
    states = problem.robot.random_configurations(np.random.default_rng(1), STATES // 4)
    return [
        Figure(f"grid building: {name}", *3 * (build,), "ms"),
        _check_time(name, space.arrays._replace(scene=geometry), states),
    ]


def _random_boxes(count: int, rng: np.random.Generator) -> list:
    """Boxes on a shell around the robot, total volume kept: many small or few large."""
    edge = 0.4 * (10.0 / count) ** (1.0 / 3.0)
    positions = _shell_points(count, rng)
    objects = tuple(SceneObject(f"box{i}", Box((edge,) * 3), pose(p)) for i, p in enumerate(positions))
    return scene_specs(Scene("boxes", objects))


def _shell_points(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points 0.7 to 1.1 m from the shoulder."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * rng.uniform(0.7, 1.1, (count, 1)) + (0.0, 0.0, 0.33)


def bench_planners(problems: int) -> list[Figure]:
    """Every planner on the tuning problems: time, counts, success; then what simplification costs."""
    figures = []
    cases = _tuning_problems(problems)
    for name in PLANNERS:
        figures += _plan_figures(name, cases)
    return figures


def _plan_figures(name: str, cases: list[PlanningProblem]) -> list[Figure]:
    planner = planner_named(name)
    seconds, projections, checks, raw, final, simplifying = [], [], [], [], [], []
    for index, problem in enumerate((cases[0], *cases)):  # the first run only loads code
        space = ConstrainedSpace(problem)
        rng = np.random.default_rng(0)
        uniform = Uniform(problem.robot.lower, problem.robot.upper)
        plan = planner.plan(space, problem.start, problem.goals, uniform, Budget(seconds=10.0), rng)
        if index == 0:
            continue
        solved = plan.status is PlanStatus.SOLVED
        seconds.append(plan.seconds if solved else np.inf)
        projections.append(plan.counters.projections)
        checks.append(plan.counters.state_checks)
        if plan.path is not None:
            shorter = simplify(space, plan.path, rng, SimplifySettings())
            raw.append(plan.path.length)
            final.append(shorter.path.length)
            simplifying.append(shorter.seconds)
    return [
        _spread(f"{name}: plan", 1e3 * np.array(seconds), "ms"),
        _spread(f"{name}: simplify", 1e3 * np.array(simplifying), "ms"),
        _spread(f"{name}: projections", np.array(projections), ""),
        _spread(f"{name}: state checks", np.array(checks), ""),
        _spread(f"{name}: raw length", np.array(raw), "rad"),
        _spread(f"{name}: final length", np.array(final), "rad"),
        Figure(f"{name}: solved of {len(seconds)}", *3 * (float(np.isfinite(seconds).sum()),), ""),
    ]


def _spread(name: str, values: np.ndarray, unit: str) -> Figure:
    """Median with the 5th and 95th percentile."""
    if len(values) == 0:
        return Figure(name, np.nan, np.nan, np.nan, unit)
    low, median, high = np.quantile(values, (0.05, 0.5, 0.95), method="nearest")
    return Figure(name, float(median), float(low), float(high), unit)


def _tuning_problems(count: int) -> list[PlanningProblem]:
    """Place-task problems whose environments are never reported."""
    problems = (place_problem(environment) for environment in TUNING_ENVIRONMENTS[:count])
    return [with_sampled_goals(problem)[0] for problem in problems if isinstance(problem, PlanningProblem)]


BENCHES: Mapping[str, Callable[[int], list[Figure]]] = {
    "kernels": bench_kernels,
    "collision": bench_collision,
    "planners": bench_planners,
}
