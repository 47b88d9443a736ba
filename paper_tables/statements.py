"""What the paper says of its planners, as statements that rows can contradict: claims.toml.

Rows of the place task existed when the statements were written; the rules of `judging` know no
suite or planner.
"""

import tomllib
from dataclasses import dataclass
from typing import Any

from paper_tables.paper_numbers import PUBLISHED

CBIRRT, OPT, CVQ = "ompl-projected", "opt-cvq-mpt", "cvq-mpt"
PREDICTED = "as predicted"
SEARCHES = (CBIRRT, "atlas-rrt", "tb-rrt")
BASELINES = {"searches": SEARCHES, "named": (*SEARCHES, "mpnet"), "predicted": (PREDICTED,)}


@dataclass(frozen=True)
class Claim:
    """`planner` needs `stated` (a fraction; 0: any) less of `metric` than every baseline.

    Without baselines: at least the fraction `stated` of its runs are what `metric` says (see
    `judging.SHARES`).
    """

    metric: str  # of `measures.VALUES`
    stated: float = 0.0
    baselines: tuple[str, ...] = ()
    planner: str = OPT
    incomparable: str = ""  # why rows do not answer it, or ""
    title: str = ""  # in our words
    paper: str = ""  # in the paper's
    suite: str = ""  # the results directory that judges it
    remark: str = ""  # what a reader must know to take the numbers rightly


def _claim(item: dict[str, Any]) -> Claim:
    """A claim of the file, with the names of its baselines."""
    named = item.pop("baselines", None)
    return Claim(**item, baselines=BASELINES.get(named, (named,)) if named else ())


_FILE = tomllib.loads((PUBLISHED / "claims.toml").read_text(encoding="utf-8"))
READING: list[str] = _FILE["reading"]
STEPS: list[tuple[str, str, str]] = _FILE["steps"]  # what is added, planner, against
CLAIMS = tuple(map(_claim, _FILE["claim"]))
