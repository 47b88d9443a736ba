"""Thousands of plans in one process by all planners: flat memory, no slow-down, no output."""

import gc
import json
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

WARM = 0.2  # share of the plans after which a process should hold all it will ever hold
GROWTH = 50 * 2**20  # [bytes] of resident memory after that
OBJECTS = 0.1  # a plan that Python's collector may count more after it
SLOWER = 1.3  # ratio of processor time a plan, last quarter to the one after warm-up
TESTS = Path(__file__).resolve().parents[1]


@pytest.mark.promise(
    "memory is flat (50 MB), no slow-down: all planners in one process", "plans", ci=0, long=10_000
)
def test_memory_and_time_of_a_long_run(trials):
    code = f"from properties.test_long_run import live; live({trials})"
    folders = [str(folder) for folder in (TESTS, TESTS / "helpers", TESTS.parent)]
    code = f"import sys; sys.path[:0] = {folders}; {code}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == "", done.stderr[-400:]
    growth, objects, slowdown = json.loads(done.stdout)
    assert growth < GROWTH and objects < OBJECTS * trials and slowdown < SLOWER


def live(plans):
    """Run `plans` plans by all planners; print growth [bytes, objects], slow-down since warm-up."""
    from process_memory import resident
    from properties.test_differential import tuning_problems

    from cvqmpt_lab.planning.pipeline import solve, with_drawn_goals
    from cvqmpt_lab.planning.planners import PLANNERS
    from cvqmpt_lab.search.result import Budget

    problems = [with_drawn_goals(problem) for problem, *_ in islice(tuning_problems(3, 1), 3)]
    work = [(planner, problem) for problem in problems for planner in PLANNERS]
    warm, seconds = max(int(WARM * plans), 2 * len(PLANNERS)), np.empty(plans)
    for k in range(plans):
        if k == warm:
            gc.collect()
            memory, objects = resident(), len(gc.get_objects())
        planner, problem = work[k % len(work)]
        began = time.process_time()
        solve(problem, planner, Budget(iterations=60), seed=k)
        seconds[k] = time.process_time() - began
    gc.collect()
    quarter = (plans - warm) // 4
    slowdown = seconds[-quarter:].mean() / seconds[warm : warm + quarter].mean()
    print(json.dumps([resident() - memory, len(gc.get_objects()) - objects, slowdown]))  # noqa: T201
