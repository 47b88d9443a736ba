"""Certified problems a second, by one process and by two at once."""

import time
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.methods.observation import Observer
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.pipeline import solve_many
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.warm_up import warm_up
from experiments.bench.timing import Figure, calibration, single
from experiments.executors import local_processes
from experiments.suites.place_task import TUNING_ENVIRONMENTS, place_problem

ENOUGH = Budget(iterations=20_000)
METHODS = ("birrt", "roadmap-cvq", "opt-cvq-mpt")
WORKERS = (1, 2)


class Share(NamedTuple):
    """What one worker did."""

    certified: int
    seconds: float
    """Wall time."""
    cpu: float
    """Processor time [s]."""


def bench_throughput(problems: int) -> list[Figure]:
    """Tuning problems from scene and cloud to certified path; what cameras see of the scenes is given.

    Robots, weights and machine code are loaded before; a scene's arrays and its checker are made on the way. The
    processor's time says what a rate would be if nobody else used the machine.
    """
    figures = [calibration()]
    environments = list(TUNING_ENVIRONMENTS)[:problems]
    for name in METHODS:
        for workers in (count for count in WORKERS if count <= len(environments)):
            parts = [environments[first::workers] for first in range(workers)]
            with local_processes(workers) as executor:
                shares = [share for _, share in executor.results(partial(_work, name), parts)]
            certified = sum(share.certified for share in shares)
            label = f"{name}, {workers} worker{'s' * (workers > 1)}"
            figures += [
                single(f"{label}: certified", certified, f"of {len(environments)}"),
                single(f"{label}: rate", certified / max(share.seconds for share in shares), "a second"),
                single(
                    f"{label}: processor time",
                    1e3 * sum(s.cpu for s in shares) / len(environments),
                    "ms each",
                ),
            ]
    return figures


def _work(name: str, environments: list[int]) -> Share:
    """Make problems and what cameras see of them, then solve them all by the clock."""
    problems = [p for p in map(place_problem, environments) if isinstance(p, PlanningProblem)]
    method, observer = planner_named(name), Observer(scenes=len(problems))
    stages = method.stages(problems[0])
    if stages.observe is not None:
        stages = replace(stages, observe=observer)
        for problem in problems:
            observer(problem)
    method = replace(method, build=lambda robot, weights: stages)
    warm_up(problems[0], method, "compiled")
    began = time.perf_counter(), time.process_time()
    solutions = solve_many(problems, method, ENOUGH)
    took = np.subtract((time.perf_counter(), time.process_time()), began)
    return Share(sum(solution.solved for solution in solutions), *map(float, took))
