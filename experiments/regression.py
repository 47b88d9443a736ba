"""Table regression: a tiny profile and the committed tables, compared with what is committed.

Budgets are iterations and simplification has no clock, so a run depends on nothing but the code, the
versions of what it calls and the processor that kernels are compiled for.
"""

import json
import math
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

from cvqmpt_lab.errors import CvqmptError, InvalidInputError
from cvqmpt_lab.files import read_json_object, write_text
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import provenance
from experiments.rows import Run, result_row
from experiments.suites.suite import suite_named
from paper_tables.paper_numbers import PUBLISHED

EXPECTED = PUBLISHED.parent / "expected" / "place_task.json"
SCHEMA = "cvqmpt-expectations/1"
SUITE = "place-task"
COUNTS = ("n_iterations", "n_projections", "n_newton_iterations", "n_state_checks", "vertices")
COLUMNS = ("fail_reason", *COUNTS, "path_length_rad", "path_sha256")
BOUNDED_COUNTS = ("n_projections", "n_state_checks")  # the other counts have no bounds worth stating
COUNT_FACTOR = 5.0  # between the geometric means over a planner's runs
LENGTH_SHARE = 0.5  # between the mean lengths over a planner's runs
WHAT_DECIDES = ("coal", "example-robot-data", "numba", "numpy", "ompl", "pin", "scipy")


@dataclass(frozen=True, order=True)
class Case:
    """One run: planner, problem, seed, budget in iterations, suite."""

    planner: str
    problem: int
    seed: int
    iterations: int
    suite: str = SUITE

    def __str__(self) -> str:
        problem = f"{self.problem}" if self.suite == SUITE else f"{self.problem} of {self.suite}"
        return f"{self.planner}, problem {problem}, seed {self.seed}, {self.iterations} iterations"


def _cases(planner: str, problems: Iterable[int], iterations: int, suite: str = SUITE) -> list[Case]:
    return [Case(planner, problem, seed, iterations, suite) for problem in problems for seed in (0, 1)]


CASES: tuple[Case, ...] = (
    Case("birrt", 5, 0, 2),  # too few: a failure is an expectation too
    *_cases("birrt", (2, 5, 8), 20_000),
    *_cases("ompl-projected", (2, 5), 20_000),
    *_cases("atlas-rrt", (8, 10), 20_000),
    *_cases("tb-rrt", (8, 10), 20_000),
    *_cases("mpnet", (2, 5), 20_000),
    *_cases("cvq-mpt", (2, 5), 20_000),
    *_cases("opt-cvq-mpt", (2, 5), 20_000),
    *_cases("opt-algorithm-2", (5,), 20_000),  # guards the latent update, which no other planner uses
    *_cases("roadmap-cvq", (2, 5, 8), 20_000),
    *_cases("birrt", (1,), 20_000, "sensor"),  # from rendered images, through filters, in a map
    *_cases("roadmap-cvq", (1,), 20_000, "sensor"),
)


@dataclass(frozen=True)
class Outcome:
    """What came of a case: its COLUMNS, None where undefined."""

    case: Case
    values: Mapping[str, str | int | float | None]


@dataclass(frozen=True)
class Expectations:
    """Committed outcomes, and the machine and versions they were made with."""

    made_with: Mapping[str, str | None]
    outcomes: tuple[Outcome, ...]

    def save(self, path: Path) -> None:
        """Write the json file at once or not at all."""
        rows = [{**asdict(item.case), "expected": dict(item.values)} for item in self.outcomes]
        record = {"schema": SCHEMA, "made_with": dict(self.made_with), "runs": rows}
        write_text(path, json.dumps(record, indent=1) + "\n")

    @staticmethod
    def load(path: Path) -> "Expectations":
        """Read what `save` wrote; InvalidInputError names the file and the cure."""
        try:
            record = read_json_object(path, "expectations")
            if record["schema"] != SCHEMA:
                raise ValueError(f"schema {record['schema']!r}, not {SCHEMA!r}")
            outcomes = []
            for row in record["runs"]:
                values = row.pop("expected")
                outcomes.append(Outcome(Case(**row), {column: values[column] for column in COLUMNS}))
            return Expectations(dict(record["made_with"]), tuple(outcomes))
        except (CvqmptError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InvalidInputError(
                f"cannot use {path} ({error}); write it with: cvqmpt check-tables --update"
            ) from error


@dataclass(frozen=True)
class Comparison:
    """How outcomes were compared (one line) and in what they differ (one line each)."""

    mode: str
    differences: tuple[str, ...]


def made_with() -> dict[str, str | None]:
    """What must be equal for runs to repeat bit for bit: processor, system, Python, versions."""
    record = provenance()
    return {
        "system": platform.system(),
        "machine": platform.machine(),
        "cpu_model": record["cpu_model"],
        "python": ".".join(platform.python_version_tuple()[:2]),
        **{name: record["versions"][name] for name in WHAT_DECIDES},
    }


@lru_cache(maxsize=8)
def _problem(suite: str, index: int) -> PlanningProblem:
    problem = suite_named(suite).solvable(index)
    assert isinstance(problem, PlanningProblem), f"{suite} is of tasks"
    return with_sampled_goals(problem)[0]


def run_case(case: Case) -> Outcome:
    """Plan, simplify and certify one case."""
    run = Run(case.suite, case.problem, case.planner, case.seed, Budget(iterations=case.iterations))
    solution = solve(
        _problem(case.suite, case.problem),
        planner_named(case.planner),
        run.budget,
        case.seed,
        clearance=False,
    )
    row = result_row(run, solution, goal_seconds=0.0)
    return Outcome(case, {column: getattr(row, column) for column in COLUMNS})


def measure(
    cases: Sequence[Case], on_progress: Callable[[int, int, str], None] | None = None
) -> tuple[Outcome, ...]:
    """Run the cases one by one; on_progress is called with (done, total, last case)."""
    outcomes = []
    for done, case in enumerate(cases, start=1):
        outcomes.append(run_case(case))
        if on_progress:
            on_progress(done, len(cases), str(case))
    return tuple(outcomes)


def compare(
    expected: Expectations, outcomes: Sequence[Outcome], here: Mapping[str, str | None]
) -> Comparison:
    """Equality on the platform and versions of the expectations, stated bounds elsewhere.

    here: what `made_with` says of the present machine.
    """
    committed = {item.case: item for item in expected.outcomes}
    pairs = [(committed[item.case], item) for item in outcomes if item.case in committed]
    missing = sorted({item.case for item in outcomes} ^ committed.keys())
    differences = [f"{case}: not in both, committed and run" for case in missing]
    other = [name for name in here if here[name] != expected.made_with.get(name)]
    if not other:
        mode = "exactly: same processor and versions as the expectations"
        return Comparison(mode, (*differences, *_unequal(pairs)))
    changed = ", ".join(f"{name} {expected.made_with.get(name)} -> {here[name]}" for name in other)
    mode = (
        f"by bounds, not bit for bit, since {changed}: reasons equal; per planner counts within a factor "
        f"{COUNT_FACTOR:g} and lengths within {LENGTH_SHARE:.0%}"
    )
    return Comparison(mode, (*differences, *_out_of_bounds(pairs)))


def _unequal(pairs: Sequence[tuple[Outcome, Outcome]], columns: Sequence[str] = COLUMNS) -> list[str]:
    """A line for the first column in which a run differs, for every run that does."""
    found = []
    for old, new in pairs:
        column = next((name for name in columns if old.values[name] != new.values[name]), None)
        if column is not None:
            found.append(f"{new.case}: {column} was {old.values[column]}, is {new.values[column]}")
    return found


def _out_of_bounds(pairs: Sequence[tuple[Outcome, Outcome]]) -> list[str]:
    """Unequal reasons of failure, and planners whose typical count or length is outside the stated bounds."""
    found = _unequal(pairs, ("fail_reason",))
    solved = [
        (old.values, new.values, new.case.planner)
        for old, new in pairs
        if old.values["fail_reason"] is new.values["fail_reason"] is None
    ]
    for planner in dict.fromkeys(name for *_, name in solved):
        both = [(old, new) for old, new, name in solved if name == planner]
        for column in BOUNDED_COUNTS:
            logs = [math.log((1 + _number(new[column])) / (1 + _number(old[column]))) for old, new in both]
            factor = math.exp(sum(logs) / len(logs))
            if not 1 / COUNT_FACTOR <= factor <= COUNT_FACTOR:
                found.append(f"{planner}, geometric mean of {column}: {factor:.2g} times the expectation")
        lengths = [sum(_number(side[i]["path_length_rad"]) for side in both) for i in (0, 1)]
        if abs(lengths[1] / lengths[0] - 1.0) > LENGTH_SHARE:
            found.append(
                f"{planner}, mean path_length_rad: {lengths[1] / lengths[0]:.2f} times the expectation"
            )
    return found


def _number(value: str | int | float | None) -> float:
    return float(value) if value is not None else 0.0
