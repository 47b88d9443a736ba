"""The paper's numbers and claims, read from ``published``; rows can contradict the claims."""

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
    value: str  # as printed in the paper
    unit: str
    note: str


def read_published(name: str, environment: str) -> tuple[PublishedValue, ...]:
    """Return the paper's numbers of an environment in a file of ``published``."""
    with (PUBLISHED / name).open(encoding="utf-8", newline="") as handle:
        values = [PublishedValue(**record) for record in csv.DictReader(handle)]
    return tuple(value for value in values if value.environment == environment)


@dataclass(frozen=True)
class Claim:
    """Claim that each planner has a smaller metric than every baseline, or a larger accuracy."""

    metric: str  # name in `measures.VALUES`, or "accuracy": the fraction of runs that are solved
    planners: tuple[str, ...]
    title: str  # our wording of the claim
    paper: str  # the paper's wording
    suite: str  # results directory whose rows judge the claim
    baselines: tuple[str, ...] = ()
    # Value that stands for a failed run: "rows", the cut-off of the rows; "largest", the largest
    # value of a run that one of the two planners solved; or a number. None: only problems that
    # both planners solved are compared.
    cutoff: Literal["rows", "largest"] | float | None = None
    # largest change that counts as no difference: of a log ratio, or of a fraction for accuracy
    margin: float = -math.log(0.9)
    similar: bool = False  # whether the claim is that at most `margin` is lost, not a gain
    by_kind: bool = False  # whether each kind of problem is a separate comparison
    runs: int | None = None  # number of runs of one planner in the paper
    untestable: str = ""  # why no rows can decide the claim, or ""
    published: str = ""  # the paper's name of the metric if it differs from ours
    # results directory with new problems; its rows replace the comparisons that it contains
    again: str = ""
    remark: str = ""  # note that a reader needs to interpret the numbers
    why: str = ""  # reason of the verdict in one line; the README shows claims that have one

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
BECAUSE: str = _FILE["because"]  # two sentences on the wording of the claims
# (component that is added, planner with it, planner without it)
STEPS: list[tuple[str, str, str]] = _FILE["steps"]
CLAIMS = tuple(map(_claim, _FILE["claim"]))
