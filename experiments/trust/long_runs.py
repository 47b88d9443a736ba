"""Thousands of plans in one process, with every planner: memory stays flat, nothing slows down, nothing is said."""

import gc
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from cvqmpt_lab.files import read_json_object, write_text
from cvqmpt_lab.methods.table import PLANNERS
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.problem import PlanningProblem
from experiments.suites.place_task import TUNING_ENVIRONMENTS, place_problem
from experiments.trust.check import Check, Trial
from experiments.trust.command import environment
from experiments.trust.memory import resident

FEW = Budget(iterations=60)
PROBLEMS = 3
WARM = 0.2
"""Share of the plans after which a process should hold all it will ever hold; two plans of each planner at least."""
GROWTH = 50 * 2**20
"""[bytes] after that."""
OBJECTS = 0.1
"""A plan that Python's collector may count more after it."""
SLOWER = 1.3
"""Ratio of processor time a plan, last fifth to the one after warm-up."""
TIMED = 1000
"""Plans from which on a slow-down can be told from noise."""


@dataclass(frozen=True)
class Life:
    """What a process saw of itself, at the end of warm-up and at its own end."""

    growth: int
    """Of resident memory [bytes]."""
    objects: int
    """More of them, as Python's collector counts."""
    slowdown: float
    """Ratio of median processor time, last fifth to the first after warm-up."""


def live(plans: int, out: Path) -> None:
    """Make so many plans with all planners in turn, and write what became of the process."""
    problems = list(islice(_problems(), PROBLEMS))
    work = list(islice(zip(cycle(PLANNERS), _each(problems, len(PLANNERS)), strict=False), plans))
    warm, seconds = max(int(WARM * plans), 2 * len(PLANNERS)), np.empty(plans)
    memory = objects = 0
    for k, (planner, problem) in enumerate(work):
        if k == warm:
            memory, objects = _settled()
        began = time.process_time()
        solve(problem, planner, FEW, seed=k, clearance=False)
        seconds[k] = time.process_time() - began
    memory_after, objects_after = _settled()
    fifth = len(seconds[warm:]) // 4
    early, late = seconds[warm : warm + fifth].mean(), seconds[plans - fifth :].mean()
    life = Life(memory_after - memory, objects_after - objects, float(late / early))
    write_text(out, json.dumps(asdict(life)))


def _problems():
    """Tuning problems with their goals."""
    for number in TUNING_ENVIRONMENTS:
        problem = place_problem(number)
        if isinstance(problem, PlanningProblem):
            yield with_sampled_goals(problem)[0]


def _each(problems: list[PlanningProblem], times: int):
    """Problems in turn, each so many times, for ever."""
    for problem in cycle(problems):
        yield from [problem] * times


def _settled() -> tuple[int, int]:
    gc.collect()
    return resident(), len(gc.get_objects())


def lives(plans: int) -> Trial:
    """Faults of a process that makes so many plans."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "life.json"
        call = f"from experiments.trust.long_runs import live, Path; live({plans}, Path({str(out)!r}))"
        done = subprocess.run([sys.executable, "-c", call], env=environment(), capture_output=True, text=True)
        if done.returncode:
            return Trial(plans, [f"ended with {done.returncode}: {done.stderr[-400:]}"])
        life = Life(**read_json_object(out))
    return Trial(
        plans, [*judged(life, plans), *([f"said at its end: {done.stderr[:400]}"] if done.stderr else [])]
    )


def judged(life: Life, plans: int) -> list[str]:
    """What is wrong with the life of a process."""
    faults = []
    if life.growth > GROWTH:
        faults.append(f"grew by {life.growth / 2**20:.1f} MiB after warm-up")
    if life.objects > OBJECTS * plans:
        faults.append(f"{life.objects} objects more than after warm-up")
    if plans >= TIMED and life.slowdown > SLOWER:
        faults.append(f"a plan takes {life.slowdown:.2f} times what it took after warm-up")
    return faults


CHECKS = (
    Check(
        "memory is flat (50 MB), no slow-down, nothing said at the end: all planners in one process",
        "plans",
        0,
        10_000,
        lives,
    ),
)
