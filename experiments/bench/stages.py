"""What surrounds the search: goals, arrays, shortening, certificate; and how tree growth scales with its size."""

import time

import numpy as np

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.distributions import Uniform
from cvqmpt_lab.kernels.search import tree_growth as kernels
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.simplify import simplify
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from experiments.bench.timing import Figure, calibration, spread

ENOUGH = Budget(iterations=20_000)
STAGES = ("goals", "space", "search", "shortening", "certificate")
SIZES = (1_000, 10_000, 100_000)  # nodes of the larger tree
SAMPLES = 16  # handed over at once


def bench_stages(problems: list[PlanningProblem]) -> list[Figure]:
    """Every stage of planning with `birrt`, by the clock of this process, which other processes do not move."""
    seconds: dict[str, list[float]] = {stage: [] for stage in STAGES}
    looks, lengths = [], []
    for problem in problems:
        clock = [time.process_time()]
        problem, _ = with_sampled_goals(problem)
        clock.append(time.process_time())
        space, rng = ConstrainedSpace(problem), np.random.default_rng(0)
        clock.append(time.process_time())
        uniform = Uniform(problem.robot.lower, problem.robot.upper)
        plan = BiRRT().search(space, problem.start, problem.goals, uniform, ENOUGH, rng)
        clock.append(time.process_time())
        if plan.path is None:
            continue
        shorter = simplify(space, plan.path, rng)
        clock.append(time.process_time())
        certificate = certify(problem, shorter.path)
        clock.append(time.process_time())
        for stage, took in zip(STAGES, np.diff(clock), strict=True):
            seconds[stage].append(took)
        looks.append(certificate.states_checked)
        lengths.append(shorter.path.length)
    return [
        calibration(),
        *(spread(f"place task: {stage}", 1e3 * np.array(took), "ms") for stage, took in seconds.items()),
        spread("place task: configurations looked at by the certificate", np.array(looks), ""),
        spread("place task: length", np.array(lengths), "rad"),
    ]


def bench_growth(problem: PlanningProblem) -> list[Figure]:
    """Tree growth against the number of nodes, by iteration and by projection, of which dense trees need more.

    Connections are ignored, so that trees go on growing.
    """
    solve(problem, "birrt", ENOUGH, seed=0, clearance=False)  # only loads code
    space = ConstrainedSpace(problem)
    arrays = space.arrays._replace(step=BiRRT().step)
    trees, rng = kernels.plant(problem.start, problem.goals, 4 * SIZES[0]), np.random.default_rng(0)
    figures = [calibration()]
    for size in SIZES:
        iteration: list[float] = []
        projection: list[float] = []
        while trees.size.max() < 1.2 * size:
            samples = problem.robot.random_configurations(rng, SAMPLES)
            before, began, first = space.counters, time.process_time(), 0
            while first < SAMPLES:
                status, first = kernels.grow(arrays, trees, samples, first, True, BiRRT().reach)
                trees = kernels.enlarged(trees) if status == kernels.FULL else trees
            if trees.size.max() > 0.8 * size:
                took = 1e6 * (time.process_time() - began)
                iteration.append(took / SAMPLES)
                projection.append(took / space.counters_since(before).projections)
        figures.append(spread(f"birrt: an iteration with {size} nodes", np.array(iteration), "us"))
        figures.append(spread(f"birrt: a projection, all in, with {size} nodes", np.array(projection), "us"))
    return figures
