"""The paper's numbers and sentences, read from ``published``; rows can contradict the sentences."""

import csv
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

PUBLISHED = Path(__file__).resolve().parent / "published"
CBIRRT, UNIFORM, CVQ, OPT = "ompl-projected", "ompl-uniform", "ompl-cvq", "ompl-opt-cvq"
SEARCHES = (CBIRRT, "atlas-rrt", "tb-rrt")
# planners of the paper's tables, and planners that run its experiment
IN_OMPL = {"cvq-mpt": CVQ, "opt-cvq-mpt": OPT, "mpnet": "ompl-mpnet"}


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


def in_ompl(values: Iterable[PublishedValue]) -> list[PublishedValue]:
    """Return the paper's numbers under the names of the planners that run its experiment."""
    return [replace(value, planner=IN_OMPL.get(value.planner, value.planner)) for value in values]


@dataclass(frozen=True)
class Claim:
    """A sentence: each planner has a smaller measure than every baseline, or solves more."""

    title: str
    sentence: str  # the paper's words
    suites: tuple[str, ...]  # results directories whose rows judge the claim
    planners: tuple[str, ...]
    baselines: tuple[str, ...]
    measure: Literal["cost", "length", "execution", "solved"]
    paper: str  # name of the measure in the paper's table, or "" where it has no number
    similar: bool = False  # of shares: whether the claim is that not many fewer are solved
    pooled: bool = False  # whether effects of kinds of problems are pooled
    # of times: the smaller limit of both planners, up to which shares are compared [s]
    limit: float = 100.0
    untestable: str = ""  # why no rows can decide the claim, or ""
    remark: str = ""  # what a reader needs to interpret the numbers
    answers: str = ""  # part of the answer in one line that this claim gives, or ""

    @property
    def is_share(self) -> bool:
        """Whether the measure is a share of problems."""
        return self.measure == "solved"


def _claim(item: dict[str, Any]) -> Claim:
    """Return a claim of the file with its planners and baselines."""
    groups = {"both": (CVQ, OPT), "searches": SEARCHES, "none": ()}
    named = {key: groups.get(item[key], (item[key],)) for key in ("planners", "baselines")}
    return Claim(**item | named | {"suites": tuple(item["suites"])})


_FILE = tomllib.loads((PUBLISHED / "claims.toml").read_text(encoding="utf-8"))
READING: list[str] = _FILE["reading"]
# smallest number of the rule of random streams whose rows are judged, see `provenance.STREAMS`
STREAMS: int = _FILE["streams"]
# first and last problem that are judged, by suite; all of a suite that is not named
PROBLEMS: dict[str, list[int]] = _FILE.get("problems", {})
CLAIMS = tuple(map(_claim, _FILE["claim"]))
