"""Numbers of committed rows as text, for pages whose words stand in `templates/`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf

from cvqmpt_lab.benchmarks.results.row import split_problem
from cvqmpt_lab.benchmarks.results.statistics import Interval
from cvqmpt_lab.paper_tables.evidence import Evidence
from cvqmpt_lab.paper_tables.factorial_table import CONTRASTS
from cvqmpt_lab.paper_tables.measures import (
    REFERENCE,
    VALUES,
    Rows,
    SuiteRuns,
    censored,
    grouped,
    mean_ratio,
    paired,
    problem_mean,
    problem_median,
)
from cvqmpt_lab.paper_tables.motion_bench_table import LEFT_OUT
from cvqmpt_lab.paper_tables.ompl_table import capped, means_ratio, solved_at
from cvqmpt_lab.paper_tables.table_engine import suite_runs
from cvqmpt_lab.paper_tables.writers import estimate, number


@dataclass(frozen=True)
class Quoted:
    """Numbers that templates may quote, of results directories by name.

    Methods take a directory's name and a planner's. Where nothing else is said, they return a
    number with its 95 % interval. KeyError: there are no such rows.
    """

    results: Mapping[str, Evidence]

    def rows(self, name: str, planner: str, kind: str = "") -> Rows:
        """Rows of a planner; kind: of problems, all when empty."""
        found = [
            row
            for row in self.results[name].rows
            if row.planner == planner and (not kind or split_problem(row.problem).phase == kind)
        ]
        if not found:
            raise KeyError(f"{name} has no rows of {planner} {kind}")
        return found

    def ratio(
        self, name: str, planner: str, value: str = "work", over: str = REFERENCE, kind: str = ""
    ) -> str:
        """Return the geometric mean of the ratio of a value between two planners.

        Args:
            name: name of the results directory.
            planner: whose value is divided.
            value: one of `VALUES`.
            over: planner of the divisor.
            kind: kind of problems; empty: all.
        """
        return estimate(self.interval(name, planner, value, over, kind))

    def interval(
        self, name: str, planner: str, value: str = "work", over: str = REFERENCE, kind: str = ""
    ) -> Interval:
        """Return the numbers of `ratio`.

        Args:
            name: name of the results directory.
            planner: whose value is divided.
            value: one of `VALUES`.
            over: planner of the divisor.
            kind: kind of problems; empty: all.
        """
        own, other = self.rows(name, planner, kind), self.rows(name, over, kind)
        return mean_ratio(paired(own, other, VALUES[value]))

    def means_ratio(self, name: str, planner: str, over: str, value: str = "search_cost") -> str:
        """Return the ratio of means of a cost in the paper's seconds or of a length.

        Costs are over the problems that each planner solved, lengths over those that both did.

        Args:
            name: name of the results directory.
            planner: whose value is divided.
            over: planner of the divisor.
            value: one of `VALUES`.
        """
        of_length = value == "ompl_length"
        measure = means_ratio(over, VALUES[value] if of_length else capped(value), of_length)
        runs = suite_runs(self.results[name].rows, ())
        return estimate(measure(self.rows(name, planner), runs))

    def within(self, name: str, planner: str, cost: float) -> str:
        """Return the share of problems solved at a cost in the paper's seconds or less, as text.

        Args:
            name: name of the results directory.
            planner: name of the planner.
            cost: [s].
        """
        rows = self.rows(name, planner)
        return f"{solved_at(cost)(rows, suite_runs(rows, ())).estimate:.0f} %"

    def mean(self, name: str, planner: str, value: str = "search_cost") -> str:
        """Return the mean of a value over the problems that a planner solved.

        Args:
            name: name of the results directory.
            planner: name of the planner.
            value: one of `VALUES`; costs are at most the cut-off.
        """
        of = VALUES[value] if value == "ompl_length" else capped(value)
        rows = self.rows(name, planner)
        known = [(row.problem, x) for row in rows if row.solved and (x := of(row)) is not None]
        return estimate(problem_mean([*grouped(known).values()]))

    def contrast(self, name: str, title: str, column: str = "work") -> str:
        """A cell of the contrasts of a factorial, by its title there."""
        contrast = next(item for item in CONTRASTS if item.title == title)
        return contrast.entry(SuiteRuns(self.results[name].rows, {}, (), (), {})).cell(column)

    def median(self, name: str, planner: str, value: str = "time") -> str:
        """Median of a value with failures as infinite; without an interval."""
        values = censored(self.rows(name, planner), VALUES[value])
        return number(problem_median(values).estimate)

    def slower(
        self, name: str, planner: str, planners: Sequence[str], value: str = "wall_time"
    ) -> str:
        """Return the median of a value over the smallest median of `planners`; no interval.

        Args:
            name: name of the results directory.
            planner: whose median is divided; a run that failed counts as infinite.
            planners: those that are compared.
            value: one of `VALUES`.
        """
        medians = {
            other: problem_median(censored(self.rows(name, other), VALUES[value])).estimate or inf
            for other in planners
        }
        return number(medians[planner] / min(medians.values()))

    def solved(self, name: str, planner: str) -> str:
        """Return certified runs of all runs, as "501 of 540"."""
        rows = self.rows(name, planner)
        return f"{sum(row.solved for row in rows)} of {len(rows)}"

    def posed(self, name: str, kind: str) -> int:
        """Return the number of MotionBenchMaker's problems that are not left out."""
        return sum(row.fail_reason not in LEFT_OUT for row in self.rows(name, REFERENCE, kind))


def what_to_use(quoted: Quoted) -> dict[str, Interval]:
    """Return five lines of advice, each with its planner's time over `birrt`'s time."""
    lines = {
        "any arm, also in a new scene: roadmap": ("robots", "roadmap", "own_time"),
        "problems that others wrote: roadmap": ("motion-bench", "roadmap", "own_time"),
        "narrow passages: roadmap": ("passages", "roadmap", "own_time"),
        "a Panda, whose dictionary is here: roadmap-cvq": (
            "place-task-seconds", "roadmap-cvq", "own_time",
        ),
        "a state check takes milliseconds: roadmap-cvq": (
            "place-task-seconds", "roadmap-cvq", "paper_cost",
        ),
    }  # fmt: skip
    return {line: quoted.interval(*numbers) for line, numbers in lines.items()}


def clear(text: str) -> str:
    """Return a ratio, bold where its whole interval is below 1."""
    bounds = text.partition("[")[2].rstrip("]").split(", ")
    return f"**{text}**" if len(bounds) == 2 and float(bounds[1]) < 1.0 else text
