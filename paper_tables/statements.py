"""What the paper says, from ``published``: its numbers, and statements that rows can contradict."""

import csv
import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

PUBLISHED = Path(__file__).resolve().parent / "published"
CBIRRT, OPT, CVQ = "ompl-projected", "opt-cvq-mpt", "cvq-mpt"
PREDICTED = "as predicted"
SEARCHES = (CBIRRT, "atlas-rrt", "tb-rrt")
BASELINES = {"searches": SEARCHES, "predicted": (PREDICTED,), "none": ()}
PLANNERS = {"both": (CVQ, OPT)}


@dataclass(frozen=True)
class PublishedValue:
    """One number of the paper; the fields are the columns of the files."""

    table: str
    environment: str
    planner: str
    paper_name: str
    metric: str
    value: str  # as printed there
    unit: str
    note: str


def read_published(name: str, environment: str) -> tuple[PublishedValue, ...]:
    """Return the paper's numbers of an environment in a file of ``published``."""
    with (PUBLISHED / name).open(encoding="utf-8", newline="") as handle:
        values = [PublishedValue(**record) for record in csv.DictReader(handle)]
    return tuple(value for value in values if value.environment == environment)


@dataclass(frozen=True)
class Claim:
    """Claim that each planner has less of a metric than every baseline, or solves more."""

    metric: str  # of `measures.VALUES`; or accuracy, a share of solved runs
    planners: tuple[str, ...]
    title: str  # in our words
    paper: str  # in the paper's
    suite: str  # the results directory that judges it
    baselines: tuple[str, ...] = ()
    # What a failed run counts as: the cut-off of the rows, the largest number of a run that one of
    # both solved, or a number. None: compared is what both solved.
    cutoff: Literal["rows", "largest"] | float | None = None
    margin: float = -math.log(0.9)  # up to it is no difference; of shares as a fraction
    similar: bool = False  # whether the claim is that no more than the margin is lost
    by_kind: bool = False  # whether each kind of problem is a comparison of its own
    runs: int | None = None  # of one planner in the paper's study
    untestable: str = ""  # why no rows can answer it, or ""
    published: str = ""  # the paper's name of the metric where ours differs
    # another results directory, of new problems: judges anew the comparisons that it has
    again: str = ""
    remark: str = ""  # what a reader must know to take the numbers rightly
    why: str = ""  # of the verdict, in one line; the README shows the claims that have one

    @property
    def is_share(self) -> bool:
        """Whether the metric is a share of runs."""
        return self.metric == "accuracy"

    @property
    def unit(self) -> str:
        """Unit of a change: percent, or percentage points."""
        return "pt" if self.is_share else "%"


def _claim(item: dict[str, Any]) -> Claim:
    """Return a claim of the file with its planners and baselines."""
    named = item.pop("baselines", "none")
    planners = PLANNERS.get(item["planners"], (item["planners"],))
    return Claim(**item | {"planners": planners}, baselines=BASELINES.get(named, (named,)))


_FILE = tomllib.loads((PUBLISHED / "claims.toml").read_text(encoding="utf-8"))
READING: list[str] = _FILE["reading"]
BECAUSE: str = _FILE["because"]  # why the words are what they are, in two sentences
STEPS: list[tuple[str, str, str]] = _FILE["steps"]  # what is added, planner, against
CLAIMS = tuple(map(_claim, _FILE["claim"]))
