"""`cvqmpt warmup`: compile every kernel ahead of time, so that the first plan does not wait."""

import argparse
import time

from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.table import planner_named
from cvqmpt_lab.problem import PlanningProblem
from experiments.suites import suite_named

EXAMPLES = ("cvqmpt warmup",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """None."""


def run(args: argparse.Namespace) -> int:
    """Solve one problem with a planner of either kind; whatever they call is then on disk."""
    began = time.perf_counter()
    print("compiling kernels (about half a minute, once per machine and version) ...", flush=True)
    problem = suite_named("place-task").make(0)
    assert isinstance(problem, PlanningProblem)  # environment 0 has one
    for planner in ("birrt", "ompl-projected"):
        solve(problem, planner_named(planner), Budget(seconds=10.0), seed=0)
    print(f"kernels ready after {time.perf_counter() - began:.1f} s")
    return 0
