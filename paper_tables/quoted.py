"""Numbers of committed rows as text, for pages whose words stand in `templates/`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from paper_tables.claims import Evidence
from paper_tables.factorial_table import CONTRASTS
from paper_tables.measures import (
    REFERENCE,
    VALUES,
    Rows,
    SuiteRuns,
    censored,
    fraction,
    mean_ratio,
    paired,
    problem_median,
    solved,
)
from paper_tables.writers import bounds, estimate, number


@dataclass(frozen=True)
class Quoted:
    """What templates may quote; `results` are directories of rows by name.

    Methods take a directory's name and a planner's. Where nothing else is said, they return a
    number with its 95 % interval. KeyError: there are no such rows.
    """

    results: Mapping[str, Evidence]

    def rows(self, name: str, planner: str, kind: str = "") -> Rows:
        """Rows of a planner, on problems whose names begin with `kind`."""
        own = [row for row in self.results[name].rows if row.planner == planner]
        found = [row for row in own if row.problem.startswith(kind)]
        if not found:
            raise KeyError(f"{name} has no rows of {planner} {kind}".strip())
        return found

    def ratio(
        self, name: str, planner: str, value: str = "work", over: str = REFERENCE, kind: str = ""
    ) -> str:
        """Geometric mean of the ratio of a value of `VALUES` to that of another planner."""
        own, other = self.rows(name, planner, kind), self.rows(name, over, kind)
        return estimate(mean_ratio(paired(own, other, VALUES[value])))

    def contrast(self, name: str, title: str, column: str = "work") -> str:
        """A cell of the contrasts of a factorial, by its title there."""
        contrast = next(item for item in CONTRASTS if item.title == title)
        return contrast.entry(SuiteRuns(self.results[name].rows, {}, (), (), {})).cell(column)

    def median(self, name: str, planner: str, value: str = "time", kind: str = "") -> str:
        """Median of a value with failures as infinite; without an interval."""
        values = censored(self.rows(name, planner, kind), VALUES[value])
        return number(problem_median(values).estimate)

    def solved(self, name: str, planner: str, kind: str = "") -> str:
        """Certified runs of all runs, as "501 of 540"."""
        rows = self.rows(name, planner, kind)
        return f"{sum(row.solved for row in rows)} of {len(rows)}"

    def share(self, name: str, planner: str) -> str:
        """Percentage of solved runs with its interval."""
        share = fraction(self.rows(name, planner), solved).scaled(100)
        return f"{number(share.estimate)} {bounds(share)}"

    def commits(self, names: Sequence[str]) -> str:
        """Commits that rows were made at."""
        found = dict.fromkeys(str(self.results[name].record["git_commit"])[:8] for name in names)
        return " and ".join(found)


def short(text: str) -> str:
    """A number without its interval."""
    return text.partition(" [")[0]
