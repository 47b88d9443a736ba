"""The parts of a suite's declaration: problems, planners, amounts and table.

Problems and tables are functions given by name and imported when they are first called: planning a
problem of a suite imports no tables, and rendering a table imports no robots.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import Imported
from cvqmpt_lab.planning.by_name import declared

if TYPE_CHECKING:
    from cvqmpt_lab.benchmarks.item import Solvable, SuiteItem


def problem_maker(name: str, **options: Any) -> Callable[[Any], Any]:
    """Return a function MODULE:FUNCTION of this folder that makes the problem of an index."""
    function = Imported(f"cvqmpt_lab.benchmarks.{name}")
    return partial(function, **options) if options else function


def table_maker(name: str, **options: Any) -> Callable[..., Any]:
    """Return a function MODULE:FUNCTION of the tables, with options."""
    return partial(Imported(f"cvqmpt_lab.paper_tables.{name}"), **options)


PLACE_TABLE = Imported("cvqmpt_lab.paper_tables.layouts:place_table")


@dataclass(frozen=True, kw_only=True)
class Amount:
    """Part of a suite that a profile of `cvqmpt reproduce all` runs; several amounts add up."""

    profile: str = "full"
    problems: int | None = None  # number of problems, from the first on; None: all
    seeds: int = 1
    cutoff: float = 10.0  # [s]
    cost: float | None = None  # limit in the paper's seconds, in place of `cutoff`
    planners: tuple[str, ...] | None = None  # None: those of the suite
    folder: str | None = None  # folder of the results; None: the name of the suite
    late: bool = False  # run after all amounts that are not late


class PlannerGroups:
    """Groups of planners that suites run."""

    quick = (*declared("quick"),)
    slow = (*declared("slow"),)
    in_ompl = (*declared("in-ompl"),)
    every = (*(name for name, planner in declared().items() if planner.group != "in-ompl"),)
    paper = ("ompl-projected", *slow, *in_ompl[1:4])  # Table I
    paper_alone = ("ompl-projected", "ompl-cvq", "ompl-opt-cvq")  # Table II, other constraints
    few = ("birrt", "ompl-projected", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq")
    tuned = (*few, "birrt-printed", "cvq-tuned")
    # `cvq-tuned` along straight lines instead of predicted sequences, and random roadmaps
    without_learning = (
        "cvq:nearest-lines+along+free-draws+reach=1",
        *("roadmap-uniform-0", "roadmap-uniform-1", "roadmap-uniform-2"),
    )


@dataclass(frozen=True, kw_only=True)
class Suite:
    """A named, ordered set of problems or tasks, and how their rows are made and shown."""

    name: str
    title: str  # title of the table
    problems: Sequence[Any]  # indices, or names of the problems of a folder
    make: Callable[[Any], "SuiteItem"]  # problem or task of an element of `problems`
    planners: tuple[str, ...] = PlannerGroups.every  # run unless others are named
    amounts: tuple[Amount, ...] = ()
    # SuiteTable of the suite's rows and the paper's numbers
    table: Callable[..., Any] = PLACE_TABLE
    # file in ``paper_tables/published`` and environment there of the paper's numbers
    paper: tuple[str, str] | None = None
    # Attachment that pictures show in the hand where the problems do not model it
    shown_in_hand: Callable[[], Any] | None = None
    of_tasks: bool = False  # items are tasks: a row is one phase of a task
    # every planner computes its own distance field and edge costs of a cloud
    new_scenes: bool = True
    simplified_by_ompl: bool = False  # whether rows have lengths after OMPL's simplification
    # limit of a run in the paper's seconds if no other limit is given; None: 10 s of wall time
    cost: float | None = None
    # [rad] longest extension of all planners with trees if no other is given; None: each its own
    reach: float | None = None
    # further settings on which the rows depend, as json values
    settings: Mapping[str, object] = field(default_factory=dict)
    # sha256 of a folder's problems, by name
    digests: Mapping[str, str] = field(default_factory=dict)

    def item(self, index: int | str) -> "SuiteItem":
        """Return problem or task `index`; InvalidInputError names the valid range."""
        if index not in self.problems:
            raise InvalidInputError(
                f"unknown problem {index} of suite {self.name}; valid indices: {self.problems[0]} "
                f"to {self.problems[-1]}"
            )
        return self.make(index)

    def solvable(self, index: int | str) -> "Solvable":
        """Return problem or task `index`; the problem of a scanned scene is in its map.

        Raises:
            InvalidInputError: the index is unknown, no problem could be made for it, or it has
                several.
        """
        from cvqmpt_lab.benchmarks.item import (
            ExecutedProblem,
            Phases,
            SensedProblem,
            UnsolvableProblem,
        )

        item = self.item(index)
        if isinstance(item, UnsolvableProblem):
            raise InvalidInputError(
                f"problem {index} of {self.name} has no solution: {item.reason}"
            )
        if isinstance(item, Phases):
            raise InvalidInputError(
                f"task {index} of {self.name} is {len(item.problems)} problems; write them to "
                f"files, and plan one: cvqmpt problems export {self.name} --out DIR"
            )
        return item.problem if isinstance(item, SensedProblem | ExecutedProblem) else item

    @property
    def carried(self) -> tuple[Any, ...]:
        """Attachments that pictures show in the hand beyond those of the problem."""
        return () if self.shown_in_hand is None else (self.shown_in_hand(),)
