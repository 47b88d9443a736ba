"""What the pinned arithmetic costs: the same problems in two processes that take turns.

``python -m cvqmpt_lab.experiments.bench.pin_cost`` prints processor time with the pin over time
without it (geometric means over problems, of the least of several runs). Problems of
`motion-bench` are left out unless ``cvqmpt problems fetch motion-bench`` has fetched them.
"""

import json
import math
import os
import subprocess
import sys
from statistics import fmean

from cvqmpt_lab.base.arithmetic import NATIVE, PINNED
from cvqmpt_lab.base.errors import CvqmptError

PROBLEMS, REPEATS = 40, 4  # problems of a suite, and runs of each
PLANNED = (("place-task", "birrt"), ("place-task", "cvq-mpt"), ("motion-bench", "birrt"))
CHILD = """
import json, sys, time
from cvqmpt_lab import Budget, solve, suite_named
from cvqmpt_lab.planning.warm_up import compile_kernels
compile_kernels(lambda *_: None)
for line in sys.stdin:
    suite, planner, index = json.loads(line)
    problem = suite_named(suite).solvable(index)
    began = time.process_time()
    found = solve(problem, planner, Budget(iterations=20_000), seed=0)
    whole = time.process_time() - began
    plan = found.plan
    parts = whole, plan.search_seconds, plan.timings.predict, plan.timings.encode
    print(json.dumps(parts), flush=True)
"""
PARTS = "goals to certificate", "search", "prediction", "encoding"


def started(**variables: str) -> subprocess.Popen:
    """Start a process that answers (suite, planner, index) with seconds."""
    clean = {name: value for name, value in os.environ.items() if name not in PINNED}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    return subprocess.Popen(
        [sys.executable, "-c", CHILD],
        env=clean | threads | variables,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    )


def answer(process: subprocess.Popen, question: tuple[str, str, int]) -> list[float | None]:
    """Return the seconds of the parts of a plan."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(json.dumps(question) + "\n")
    seconds: list[float | None] = json.loads(process.stdout.readline())
    return seconds


def indices(suite: str) -> list[int]:
    """Return PROBLEMS indices that can be planned, evenly spread; none if they are not fetched."""
    from cvqmpt_lab import PlanningProblem, suite_named

    every = suite_named(suite).problems
    try:
        made = (k for k in every[:: len(every) // (2 * PROBLEMS) or 1])
        found = [k for k in made if isinstance(suite_named(suite).item(k), PlanningProblem)]
    except CvqmptError:
        return []
    return [int(k) for k in found[:PROBLEMS]]


def main() -> None:
    """Measure and print."""
    processes = started(), started(**{NATIVE: "1"})
    for suite, planner in PLANNED:
        least: dict[tuple[int, int, int], float] = {}
        for repeat in range(REPEATS):
            for index in indices(suite):
                for side in (0, 1) if repeat % 2 else (1, 0):
                    parts = answer(processes[side], (suite, planner, index))
                    for part, seconds in enumerate(parts):
                        if seconds:
                            key = index, part, side
                            least[key] = min(least.get(key, math.inf), seconds)
        for part, name in enumerate(PARTS):
            both = [k for k, p, side in least if p == part and side == 0 and (k, p, 1) in least]
            logs = [math.log(least[k, part, 0] / least[k, part, 1]) for k in both]
            if logs:
                print(
                    f"{suite:13} {planner:8} {name:21} {math.exp(fmean(logs)):.3f} (n={len(logs)})"
                )
    for process in processes:
        process.kill()


if __name__ == "__main__":
    main()
