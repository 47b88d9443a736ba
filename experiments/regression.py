"""Regression test of result rows: a few short runs are compared with committed values.

Budgets are iterations, not seconds, so that results depend only on the code, the versions of
packages and the processor that runs the compiled kernels. `Guarded` does the same for planners on a
folder of problem files.
"""

import json
import platform
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, require_kind, whole_number
from cvqmpt_lab.base.files import read_json_object, write_text
from cvqmpt_lab.base.values import scalar
from cvqmpt_lab.benchmarks.suite import folder_suite, suite_named
from cvqmpt_lab.experiments.experiment import Experiment
from cvqmpt_lab.experiments.run import executor_for, result_row, run_experiment
from cvqmpt_lab.paper_tables.measures import grouped
from cvqmpt_lab.paper_tables.statements import PUBLISHED
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import cpu_facts, provenance
from cvqmpt_lab.search.result import Budget

EXPECTED = PUBLISHED.parent / "expected" / "place_task.json"
EXPECTATIONS_SCHEMA = "cvqmpt-expectations/1"
SUITE = "place-task"
COUNTS = ("n_iterations", "n_projections", "n_newton_iterations", "n_state_checks", "vertices")
GUARDED_COLUMNS = ("fail_reason", *COUNTS, "path_length_rad", "path_sha256", "g_sampled")
# Largest relative change, on another processor, of the sum of a count or of path lengths over the
# runs of a planner. All sums were equal to three digits on an AMD EPYC, on an Intel Xeon and in
# code for any x86-64, which rounds differently, except the sums of tb-rrt, which became up to 2.8
# times as large.
WITHIN = 0.02
FORKING = ("tb-rrt",)  # planners whose sums are not compared on another processor


class Case(NamedTuple):
    """One run: planner, problem, seed, budget in iterations, suite."""

    planner: str
    problem: int | str  # index, or name in a folder of problem files
    seed: int
    iterations: int
    suite: str = SUITE

    def __str__(self) -> str:
        problem = f"{self.problem}" if self.suite == SUITE else f"{self.problem} of {self.suite}"
        return f"{self.planner}, problem {problem}, seed {self.seed}, {self.iterations} iterations"


Values = Mapping[str, Any]  # GUARDED_COLUMNS of a run, None where undefined
CASES: tuple[Case, ...] = (
    Case("birrt", 5, 0, 2),  # too few iterations: the failure must stay the same, too
    *(
        Case(planner, problem, seed, 20_000, suite)
        for planner, problems, suite in (
            ("birrt", (2, 5, 8), SUITE),
            ("birrt-printed", (2,), SUITE),
            ("cells", (2, 5), SUITE),
            ("ompl-projected", (2, 5), SUITE),
            ("ompl-uniform", (2,), SUITE),
            ("ompl-mpnet", (5,), SUITE),
            ("ompl-cvq", (2,), SUITE),
            ("ompl-opt-cvq", (2,), SUITE),
            ("ompl-cvq-tuned", (5,), SUITE),
            ("atlas-rrt", (8, 10), SUITE),
            ("tb-rrt", (8, 10), SUITE),
            ("ompl-bkpiece", (10,), SUITE),
            ("mpnet", (2, 5), SUITE),
            ("mpnet-bridged", (2, 5), SUITE),
            ("cvq-mpt", (2, 5), SUITE),
            ("opt-cvq-mpt", (2, 5), SUITE),
            ("cvq-wide", (5,), SUITE),
            ("cvq-tuned", (2, 5), SUITE),
            ("roadmap", (2, 5, 8), SUITE),
            ("roadmap-cvq", (2, 5, 8), SUITE),
            ("cvq:transformer+wide+projected+no-cloud", (5,), "factorial"),
            ("cvq:random+decoded+algorithm-2+uniform=0.15", (5,), "factorial"),
            ("cvq:oracle+wide+algorithm-2", (2,), "factorial-constraints"),
            ("birrt", (1,), "sensor"),  # obstacles: a map of filtered rendered images
            ("roadmap-cvq", (1,), "sensor"),
            ("birrt", (0, 90), "two-arms"),  # a closed chain of each robot
        )
        for problem in problems
        for seed in (0, 1)
    ),
)


def sample() -> list[Case]:
    """Return the first case of each planner in each suite, and the case that fails."""
    kinds = {(case.planner, case.suite, case.iterations): case for case in reversed(CASES)}
    return [case for case in CASES if case in kinds.values()]


class Expectations(NamedTuple):
    """Committed values of cases, and the machine and package versions that produced them."""

    made_with: Mapping[str, str | None]
    outcomes: Mapping[Case, Values]

    def save(self, path: Path) -> None:
        """Write the json file atomically."""
        rows = [
            {**case._asdict(), "expected": dict(values)} for case, values in self.outcomes.items()
        ]
        record = {"schema": EXPECTATIONS_SCHEMA, "made_with": dict(self.made_with), "runs": rows}
        write_text(path, json.dumps(record, indent=1) + "\n")

    @staticmethod
    def load(path: Path, command: str = "cvqmpt check-tables --update") -> "Expectations":
        """Read a file that `save` wrote; errors name the file and the command that writes it."""
        try:
            record = read_json_object(path, "expectations")
            if record["schema"] != EXPECTATIONS_SCHEMA:
                raise ValueError(f"schema {record['schema']!r}, not {EXPECTATIONS_SCHEMA!r}")
            outcomes = {}
            for row in record["runs"]:
                values = row.pop("expected")
                case = Case(**row)
                whole_number("seed", case.seed)
                whole_number("iterations", case.iterations, 1)
                require_kind("planner", case.planner, str)
                outcomes[case] = {column: values[column] for column in GUARDED_COLUMNS}
                for column in (*COUNTS, "path_length_rad"):
                    scalar(float, values[column] or 0.0, column)
            if not outcomes:
                raise ValueError("no runs")
            return Expectations(dict(record["made_with"]), outcomes)
        except (CvqmptError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidInputError(
                f"cannot use {path} ({error}); write it with: {command}"
            ) from error


def made_with() -> dict[str, str | None]:
    """Return the facts that decide bit-for-bit equal results: processor, system, packages."""
    record = provenance()
    packages = ("coal", "example-robot-data", "numba", "numpy", "ompl", "pin", "scipy")
    return {
        "system": platform.system(),
        "machine": platform.machine(),
        "cpu_model": record["cpu_model"],
        # virtual machines give one name to processors on which OpenBLAS rounds differently
        "cpu_ids": " ".join(cpu_facts(r"^(?:cpu family|model|stepping)\s*: (\d+)")[:3]),
        "instructions": " ".join(np.show_config(mode="dicts")["SIMD Extensions"]["found"]),
        "python": ".".join(platform.python_version_tuple()[:2]),
        **{name: record["versions"][name] for name in packages},
    }


@lru_cache(maxsize=8)
def _problem(suite: str, index: int) -> PlanningProblem:
    problem = suite_named(suite).solvable(index)
    assert isinstance(problem, PlanningProblem), f"{suite} is a suite of tasks"
    return problem


def measure(
    cases: Sequence[Case], on_progress: Callable[[int, int, str], None] | None = None
) -> dict[Case, Values]:
    """Plan, simplify and certify each case; on_progress is called with (done, total, last case)."""
    outcomes: dict[Case, Values] = {}
    for case in cases:
        budget, problem = Budget(iterations=case.iterations), _problem(case.suite, case.problem)
        solution = solve(problem, planner_named(case.planner), budget, case.seed)
        experiment = Experiment(case.suite, (case.problem,), (case.planner,), (case.seed,), budget)
        row = result_row(experiment.runs[0], solution, 0.0)
        outcomes[case] = {column: getattr(row, column) for column in GUARDED_COLUMNS}
        if on_progress:
            on_progress(len(outcomes), len(cases), str(case))
    return outcomes


def compare(
    expected: Expectations,
    outcomes: Mapping[Case, Values],
    here: Mapping[str, str | None],
    within: float = WITHIN,
) -> tuple[str, list[str]]:
    """Compare outcomes with expectations.

    With the processor and versions of the expectations, values must be equal. With others, reasons
    of failure must be equal, and sums over the runs of a planner may differ by a fraction.

    Args:
        expected: committed values.
        outcomes: values of this machine by case.
        here: `made_with` of this machine.
        within: largest relative difference of sums.

    Returns:
        The kind of comparison, and a line for each difference.
    """
    pairs = [
        (case, expected.outcomes[case], new)
        for case, new in outcomes.items()
        if case in expected.outcomes
    ]
    missing = sorted(outcomes.keys() ^ expected.outcomes.keys(), key=str)
    differences = [f"{case}: either expected or run, but not both" for case in missing]
    other = [name for name in here if here[name] != expected.made_with.get(name)]
    if not other:
        mode = "exactly: same processor and versions as the expectations"
        return mode, differences + _unequal(pairs, GUARDED_COLUMNS)
    changed = ", ".join(f"{name} {expected.made_with.get(name)} -> {here[name]}" for name in other)
    mode = (
        f"within bounds, not bit for bit, since {changed}: reasons of failure must be equal; each "
        "count and the path length, summed over the runs of a planner, may differ by "
        f"{within:.3g} times the expected sum (sums of {', '.join(FORKING)} are not compared)"
    )
    return mode, differences + _unequal(pairs, ("fail_reason",)) + _out_of_bounds(pairs, within)


def _unequal(pairs: Sequence[tuple[Case, Values, Values]], columns: Sequence[str]) -> list[str]:
    """Return a line for each run that differs, with the first different column."""
    found = []
    for case, old, new in pairs:
        changed = [name for name in columns if old[name] != new[name]]
        found += [f"{case}: {name} was {old[name]}, is {new[name]}" for name in changed[:1]]
    return found


def _out_of_bounds(pairs: Sequence[tuple[Case, Values, Values]], within: float) -> list[str]:
    """Return a line for each sum over a planner's runs that is out of bounds."""
    found = []
    equal = [
        (case.planner, (old, new))
        for case, old, new in pairs
        if old["fail_reason"] == new["fail_reason"] and case.planner not in FORKING
    ]
    for planner, both in grouped(equal).items():
        for column in (*COUNTS, "path_length_rad"):
            before, after = (sum(side[i][column] or 0 for side in both) for i in (0, 1))
            if not abs(after - before) <= within * before:
                found.append(
                    f"{planner}, {column} of {len(both)} runs: was {before:g}, is {after:g}"
                )
    return found


class Guarded(NamedTuple):
    """Settings of the runs on each problem of a folder."""

    planners: Sequence[str]
    seeds: Sequence[int]
    iterations: int  # budget of a run

    def measure(
        self, folder: Path, jobs: int, on_progress: Callable[[int, int, str], None]
    ) -> dict[Case, Values]:
        """Run every planner on every problem of a folder, and return the values of each run.

        Args:
            folder: folder of problem files.
            jobs: number of runs at the same time.
            on_progress: called with (done, total, last run).
        """
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
            # a constant name: the path of the folder differs between machines
            Case(row.planner, row.problem, row.seed, self.iterations, "the folder"): {
                column: getattr(row, column) for column in GUARDED_COLUMNS
            }
            for row in rows
        }


def guarded_by(
    expected: Expectations, planners: Sequence[str] = ()
) -> tuple[Guarded, Expectations]:
    """Return the settings of the runs behind expectations, and the expectations themselves.

    Args:
        expected: committed values.
        planners: planners to keep; all planners if empty.

    Raises:
        InvalidInputError: a planner has no expected values.
    """
    known = list(dict.fromkeys(case.planner for case in expected.outcomes))
    for name in planners:
        if name not in known:
            raise InvalidInputError(
                f"planner {name!r} has no expected values; choose from {', '.join(known)}, or "
                "write new ones with --update and all planners"
            )
    chosen = planners or known
    kept = {case: values for case, values in expected.outcomes.items() if case.planner in chosen}
    seeds = sorted({case.seed for case in kept})
    iterations = max(case.iterations for case in kept)
    return Guarded(chosen, seeds, iterations), expected._replace(outcomes=kept)
