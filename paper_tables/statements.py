"""What the paper says, from ``published``: its numbers, and statements that rows can contradict.

Rows of the place task existed when the statements were written; the rules of `judging` know no
suite or planner.
"""

import csv
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PUBLISHED = Path(__file__).resolve().parent / "published"
CBIRRT, OPT, CVQ = "ompl-projected", "opt-cvq-mpt", "cvq-mpt"
PREDICTED = "as predicted"
SEARCHES = (CBIRRT, "atlas-rrt", "tb-rrt")
BASELINES = {"searches": SEARCHES, "named": (*SEARCHES, "mpnet"), "predicted": (PREDICTED,)}


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
    """The paper's numbers of an environment in a file of ``published``."""
    with (PUBLISHED / name).open(encoding="utf-8", newline="") as handle:
        values = [PublishedValue(**record) for record in csv.DictReader(handle)]
    return tuple(value for value in values if value.environment == environment)


@dataclass(frozen=True)
class Claim:
    """`planner` needs `stated` (a fraction; 0: any) less of `metric` than every baseline.

    Without baselines: at least the fraction `stated` of its runs are what `metric` says.
    """

    metric: str  # of `measures.VALUES`; or accuracy, failed, solved_in_time
    stated: float = 0.0
    baselines: tuple[str, ...] = ()
    planner: str = OPT
    incomparable: str = ""  # why rows without such values do not answer it, or ""
    published: str = ""  # the paper's name of the metric where ours differs
    title: str = ""  # in our words
    paper: str = ""  # in the paper's
    suite: str = ""  # the results directory that judges it
    remark: str = ""  # what a reader must know to take the numbers rightly
    why: str = ""  # of the verdict, in one line; the README shows the claims that have one


def _claim(item: dict[str, Any]) -> Claim:
    """A claim of the file, with the names of its baselines."""
    named = item.pop("baselines", None)
    return Claim(**item, baselines=BASELINES.get(named, (named,)) if named else ())


_FILE = tomllib.loads((PUBLISHED / "claims.toml").read_text(encoding="utf-8"))
READING: list[str] = _FILE["reading"]
STEPS: list[tuple[str, str, str]] = _FILE["steps"]  # what is added, planner, against
CLAIMS = tuple(map(_claim, _FILE["claim"]))
