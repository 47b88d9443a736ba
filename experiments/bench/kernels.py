"""Benchmarks: what things cost on this machine. Never a test; ratios within one run are what to quote."""

import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from cvqmpt_lab.constraints.task_space_region import MAX_ITERATIONS, TOLERANCE, RegionConstraint, upright
from cvqmpt_lab.distributions import Uniform
from cvqmpt_lab.kernels.compiling import kernel
from cvqmpt_lab.kernels.manifold.kinematics import forward_kinematics
from cvqmpt_lab.kernels.manifold.projection import project_batch, projection_scratch
from cvqmpt_lab.methods.table import PLANNERS
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.result import Budget, PlanStatus
from cvqmpt_lab.planning.simplify import SimplifySettings, simplify
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.exact_checker import CollisionChecker
from cvqmpt_lab.scene.families import random_scene
from experiments.bench.calibration import bench_calibration
from experiments.bench.collision import STATES, bench_collision
from experiments.bench.networks import bench_networks
from experiments.bench.scanning import bench_scan
from experiments.bench.seeing import bench_sight
from experiments.bench.stages import bench_growth, bench_stages
from experiments.bench.throughput import bench_throughput
from experiments.bench.timing import Figure, calibration, single, spread, timed
from experiments.suites.place_task import TUNING_ENVIRONMENTS, place_problem

LONG_RUN = 2.0
FIRST_RANDOM_SCENE = 700_000  # seeds of scenes that nothing else uses


@kernel
def _poses_of_all(kinematics, configurations, link_rotation, link_translation):
    for i in range(configurations.shape[0]):
        forward_kinematics(kinematics, configurations[i], link_rotation, link_translation)


def bench_kernels() -> list[Figure]:
    """Forward kinematics and projection, one configuration at a time, and batches of constraint gradients."""
    problem = _tuning_problems(1)[0]
    robot, constraint = problem.robot, RegionConstraint(problem.robot, (upright(),))
    rng = np.random.default_rng(0)
    uniform = robot.random_configurations(rng, STATES)
    regions = constraint.regions
    scratch, iterations = projection_scratch(robot.dof, regions), np.empty(STATES, dtype=np.int64)

    def project(configurations: np.ndarray) -> Callable[[], object]:
        return lambda: project_batch(
            robot.kinematics, regions, configurations.copy(), TOLERANCE, MAX_ITERATIONS, scratch, iterations
        )

    on_manifold = uniform.copy()
    project_batch(robot.kinematics, regions, on_manifold, TOLERANCE, MAX_ITERATIONS, scratch, iterations)
    near = on_manifold + rng.normal(0.0, 0.05 / np.sqrt(robot.dof), on_manifold.shape)
    poses = (np.zeros((robot.dof + 1, 3, 3)), np.zeros((robot.dof + 1, 3)))
    batch = uniform[:10_000]

    def gradient() -> None:
        F, J = constraint.residual_and_jacobian(batch)
        np.einsum("bm,bmn->bn", F, J)

    return [
        calibration(),
        timed("forward kinematics", lambda: _poses_of_all(robot.kinematics, uniform, *poses), STATES),
        timed("projection, 0.05 rad off the manifold", project(near), STATES),
        timed("projection, uniform sample", project(uniform), STATES),
        timed("kinematics + residual + gradient, batch of 10 000", gradient, len(batch)),
    ]


def bench_planners(problems: int) -> list[Figure]:
    """Every planner on the tuning problems: time, counts, success; then what simplification costs."""
    figures = []
    cases = _tuning_problems(problems)
    for name in PLANNERS:
        figures += _plan_figures(name, cases)
    return figures


def _plan_figures(name: str, cases: list[PlanningProblem]) -> list[Figure]:
    seconds, projections, checks, raw, final, simplifying = [], [], [], [], [], []
    for index, problem in enumerate((cases[0], *cases)):  # the first run only loads code
        solution = solve(problem, name, Budget(seconds=10.0), seed=0, clearance=False)
        plan = solution.plan
        if index == 0:
            continue
        solved = plan.status is PlanStatus.SOLVED
        seconds.append(plan.seconds if solved else np.inf)
        projections.append(plan.counters.projections)
        checks.append(plan.counters.state_checks)
        if plan.path is not None and solution.simplified is not None:
            raw.append(plan.path.length)
            final.append(solution.simplified.path.length)
            simplifying.append(solution.simplified.seconds)
    return [
        spread(f"{name}: plan", 1e3 * np.array(seconds), "ms"),
        spread(f"{name}: simplify", 1e3 * np.array(simplifying), "ms"),
        spread(f"{name}: projections", np.array(projections), ""),
        spread(f"{name}: state checks", np.array(checks), ""),
        spread(f"{name}: raw length", np.array(raw), "rad"),
        spread(f"{name}: final length", np.array(final), "rad"),
        single(f"{name}: solved of {len(seconds)}", np.isfinite(seconds).sum(), ""),
    ]


def _tuning_problems(count: int) -> list[PlanningProblem]:
    """Place-task problems whose environments are never reported."""
    return [with_sampled_goals(problem)[0] for problem in _place_problems(count)]


def _place_problems(count: int) -> Iterator[PlanningProblem]:
    """The same, without their goals."""
    problems = (place_problem(environment) for environment in TUNING_ENVIRONMENTS[:count])
    return (problem for problem in problems if isinstance(problem, PlanningProblem))


def bench_unconstrained(problems: int) -> list[Figure]:
    """Free paths among random cubes and spheres: the first one, the shortened one, and how far from the best."""
    solved = 0
    first, total, above_same, above_best = [], [], [], []
    for index, problem in enumerate((next(_random_problems(1)), *_random_problems(problems))):
        space = ConstrainedSpace(problem)
        uniform = Uniform(problem.robot.lower, problem.robot.upper)
        rng = np.random.default_rng(index)
        plan = BiRRT().search(space, problem.start, problem.goals, uniform, Budget(seconds=2.0), rng)
        if plan.path is None or index == 0:
            continue
        solved += 1
        shorter = simplify(space, plan.path, rng, SimplifySettings(attempts=96))
        first.append(plan.seconds)
        total.append(plan.seconds + shorter.seconds)
        patient = SimplifySettings(attempts=10**9, seconds=LONG_RUN, patience=10**9)
        same = simplify(space, plan.path, rng, patient).path.length
        best = min(same, _best_length(space, problem, uniform, rng))
        above_same.append(100.0 * (shorter.path.length / same - 1.0))
        above_best.append(100.0 * (shorter.path.length / best - 1.0))
    return [
        calibration(),
        spread("random scenes: first path", 1e3 * np.array(first), "ms"),
        spread("random scenes: shortened path", 1e3 * np.array(total), "ms"),
        spread(f"random scenes: above the same path shortened for {LONG_RUN:g} s", np.array(above_same), "%"),
        spread(f"random scenes: above the best of {LONG_RUN:g} s of restarts", np.array(above_best), "%"),
        single(f"random scenes: solved of {problems}", solved, ""),
    ]


def _best_length(
    space: ConstrainedSpace, problem: PlanningProblem, uniform: Uniform, rng: np.random.Generator
) -> float:
    """Length [rad] of the shortest of all paths planned and shortened in LONG_RUN."""
    best, began = np.inf, time.perf_counter()
    settings = SimplifySettings(attempts=1024, patience=16)
    while (left := LONG_RUN - (time.perf_counter() - began)) > 0:
        plan = BiRRT().search(space, problem.start, problem.goals, uniform, Budget(seconds=left), rng)
        if plan.path is not None:
            best = min(best, simplify(space, plan.path, rng, settings).path.length)
    return best


def _random_problems(count: int) -> Iterator[PlanningProblem]:
    """Start and goal uniform among 8 cubes and 8 spheres, where the straight motion is not free."""
    robot = panda()
    number = 0
    while count > 0:
        scene, number = random_scene(FIRST_RANDOM_SCENE + number), number + 1
        rng = np.random.default_rng(number)
        checker = CollisionChecker(robot, scene, margin=0.001)
        states = [q for q in robot.random_configurations(rng, 64) if not checker.in_collision(q)]
        if len(states) < 2 or not checker.in_collision_batch(np.linspace(states[0], states[1], 64)).any():
            continue
        count -= 1
        yield PlanningProblem(f"random {number}", robot, scene, states[0], states[1][None])


BENCHES: Mapping[str, Callable[[int, int], list[Figure]]] = {
    "kernels": lambda problems, states: bench_kernels(),
    "collision": lambda problems, states: bench_collision(_tuning_problems(1)[0], states),
    "planners": lambda problems, states: bench_planners(problems),
    "stages": lambda problems, states: bench_stages(list(_place_problems(problems))),
    "networks": lambda problems, states: bench_networks(_tuning_problems(problems)),
    "throughput": lambda problems, states: bench_throughput(problems),
    "growth": lambda problems, states: bench_growth(_tuning_problems(1)[0]),
    "sight": lambda problems, states: bench_sight(problems),
    "calibration": lambda problems, states: bench_calibration(panda(), problems),
    "unconstrained": lambda problems, states: bench_unconstrained(problems),
    "scan": lambda problems, states: bench_scan(),
}
