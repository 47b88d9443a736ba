"""Times of start, search, shortening and certificate on this machine, and memory."""

import resource
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from cvqmpt_lab.benchmarks.place_task import TUNING_ENVIRONMENTS, place_problem
from cvqmpt_lab.certificate.certificate import Certificate, certify
from cvqmpt_lab.planning.pipeline import with_drawn_goals
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.planner_interface import Query, Uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.shortcut import simplify
from cvqmpt_lab.search.space import ConstrainedSpace

Result = TypeVar("Result")


class Measured(NamedTuple):
    """Median of a quantity, and its 5th to 95th percentile."""

    name: str
    median: float
    low: float
    high: float
    unit: str


def measured(name: str, values: Sequence[float], unit: str) -> Measured:
    """Summarise values; nan without any."""
    shares = 0.05, 0.5, 0.95
    found = np.quantile(values, shares, method="nearest") if len(values) else [np.nan] * 3
    low, median, high = map(float, found)
    return Measured(name, median, low, high, unit)


class CpuClock:
    """Processor time [ms] of calls, by name: other processes do not change it."""

    def __init__(self) -> None:
        self._found: dict[str, list[float]] = defaultdict(list)

    def __call__(self, name: str, function: Callable[..., Result], *args: object) -> Result:
        """Call a function and record its processor time."""
        began = time.process_time()
        result = function(*args)
        self._found[name].append(1e3 * (time.process_time() - began))
        return result

    def measured(self) -> list[Measured]:
        """Recorded times by name."""
        return [measured(name, found, "ms") for name, found in self._found.items()]


def tuning_problems(count: int) -> list[PlanningProblem]:
    """Return problems of the place task that no table reports, without their goals."""
    problems = (place_problem(environment) for environment in TUNING_ENVIRONMENTS[:count])
    return [problem for problem in problems if isinstance(problem, PlanningProblem)]


def stage_times(problems: int) -> list[Measured]:
    """Measure all stages of planning with `birrt` on tuning problems, start and memory."""
    clock = CpuClock()
    states: list[float] = []
    for problem in tuning_problems(problems):
        posed = clock("goals", with_drawn_goals, problem)
        certificate = plan_stages(clock, posed)
        if certificate is not None:
            states.append(certificate.states_checked)
    # of this process, before other programs are started; Linux counts in KiB
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return [
        _start("--help"),
        _start("plan", "--help"),
        *clock.measured(),
        measured("states checked by the certificate", states, ""),
        measured("memory", [memory], "MiB"),
    ]


def plan_stages(clock: CpuClock, problem: PlanningProblem, prefix: str = "") -> Certificate | None:
    """Plan a problem with given goals with `birrt`, and record the time of each stage.

    The stages' names get the prefix. Returns the certificate, or None without a path.
    """
    rng = np.random.default_rng(0)
    space = clock(f"{prefix}space", ConstrainedSpace.of, problem)
    query = Query.of(space, problem.start, problem.goals, Budget(iterations=20_000), rng)
    uniform = Uniform(problem.robot.lower, problem.robot.upper)
    plan = clock(f"{prefix}search", BiRRT().search, query, uniform)
    if plan.path is None:
        return None
    shorter = clock(f"{prefix}shortening", simplify, space, plan.path, rng)
    exact = partial(certify, exact_clearance=True)
    clock(f"{prefix}certificate with exact clearances", exact, problem, shorter.path)
    return clock(f"{prefix}certificate", certify, problem, shorter.path)


def _start(*words: str) -> Measured:
    """Return the median wall time of starting a command seven times, after a first start."""
    seconds = []
    for _ in range(8):
        began = time.perf_counter()
        command = [str(Path(sys.executable).with_name("cvqmpt")), *words]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds.append(time.perf_counter() - began)
    return measured(f"start: cvqmpt {' '.join(words)}", seconds[1:], "s")
