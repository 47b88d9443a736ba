"""Planners on a folder of problem files, to be compared with what is expected of them.

Runs are bounded by iterations and the file of expectations is that of `regression`, so that nothing
depends on the clock.
"""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from cvqmpt_lab.benchmarks.suite import folder_suite
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.search.result import Budget
from experiments.experiment import Experiment
from experiments.regression import COLUMNS, Case, Expectations, Values
from experiments.run import executor_for, run_experiment


class Guarded(NamedTuple):
    """What is run on every problem of a folder."""

    planners: Sequence[str]
    seeds: Sequence[int]
    iterations: int  # budget of a run

    def measure(
        self, folder: Path, jobs: int, on_progress: Callable[[int, int, str], None]
    ) -> dict[Case, Values]:
        """Run it, `jobs` runs at a time; no rows are kept."""
        suite = folder_suite(folder)
        experiment = Experiment(
            suite=str(folder.resolve()),
            problems=tuple(suite.problems),
            planners=tuple(self.planners),
            seeds=tuple(self.seeds),
            budget=Budget(iterations=self.iterations),
        )
        with tempfile.TemporaryDirectory() as out, executor_for(experiment, jobs) as executor:
            rows = run_experiment(experiment, Path(out), executor, (), on_progress)
        return {
            # a folder may be called otherwise on another machine
            Case(row.planner, row.problem, row.seed, self.iterations, "the folder"): {
                column: getattr(row, column) for column in COLUMNS
            }
            for row in rows
        }


def guarded_by(
    expected: Expectations, planners: Sequence[str] = ()
) -> tuple[Guarded, Expectations]:
    """What was run for expectations, and what is expected of it.

    planners: some of those of the expectations; all if empty. InvalidInputError names one of which
    nothing is expected.
    """
    known = list(dict.fromkeys(case.planner for case in expected.outcomes))
    for name in planners:
        if name not in known:
            raise InvalidInputError(
                f"nothing is expected of planner {name!r}, only of {', '.join(known)}; name all "
                "that are guarded with --update"
            )
    chosen = planners or known
    kept = {case: values for case, values in expected.outcomes.items() if case.planner in chosen}
    seeds = sorted({case.seed for case in kept})
    iterations = max(case.iterations for case in kept)
    return Guarded(chosen, seeds, iterations), expected._replace(outcomes=kept)
