"""The result of a planning run: status, path, counts, times."""

from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from numbers import Real
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, require_kind, shown, whole_number
from cvqmpt_lab.geometry.polyline import evenly_along, step_lengths
from cvqmpt_lab.search.work import search_work


class PlanStatus(StrEnum):
    """How a planning run ended. Everything but SOLVED is a failure with that reason."""

    SOLVED = "solved"
    TIMEOUT = "timeout"
    ITERATION_LIMIT = "iteration_limit"
    NO_GOAL = "no_goal"
    INVALID_START = "invalid_start"
    INVALID_GOAL = "invalid_goal"
    PLANNER_ERROR = "planner_error"  # these and the next three: of external planners
    MALFORMED_PATH = "malformed_path"
    OVERTIME = "overtime"
    NO_PATH = "no_path"  # before its time was over


@dataclass(frozen=True)
class Budget:
    """The end of a search: after seconds or iterations (repeatable bit for bit), or the first."""

    seconds: float | None = None
    iterations: int | None = None

    def __post_init__(self) -> None:
        if self.seconds is None and self.iterations is None:
            raise InvalidInputError("a budget needs seconds, iterations or both")
        if self.iterations is not None:
            # larger numbers are not exact in json
            whole = whole_number("budget iterations", self.iterations, 1, 2**53)
            object.__setattr__(self, "iterations", whole)
        if self.seconds is not None and not (isinstance(self.seconds, Real) and self.seconds > 0):
            raise InvalidInputError(f"budget seconds {shown(self.seconds)}: give a number above 0")

    def share(self, fraction: float) -> "Budget":
        """A fraction of it, at least one iteration."""
        return Budget(
            None if self.seconds is None else fraction * self.seconds,
            None if self.iterations is None else max(1, round(fraction * self.iterations)),
        )

    @classmethod
    def require(cls, value: Any, what: str = "budget") -> None:
        """Refuse what is no valid budget; InvalidInputError names it `what`."""
        cure = "give Budget(seconds=...), Budget(iterations=...) or both in one"
        require_kind(what, value, cls, cure)


@dataclass(frozen=True)
class Counters:
    """Work done, in machine-independent units."""

    projections: int = 0
    newton_iterations: int = 0
    state_checks: int = 0
    iterations: int = 0
    # states whose clearance was read from a distance field: approximate checks, which free no path
    clearances: int = 0
    extensions: int = 0  # of trees, that added nodes: so many ends; roots are none
    # of draws, before trees extend towards them: a part of projections and newton_iterations
    draw_projections: int = 0
    draw_newton_iterations: int = 0

    @property
    def work(self) -> float:
        """`projections + state checks + CLEARANCE_COST * clearances`."""
        return search_work(self.projections, self.state_checks, self.clearances)


@dataclass(frozen=True)
class Timings:
    """Parts of a planning run that are not search [s]; None where a planner has no such part."""

    encode: float | None = None  # from the point cloud to what the network keeps of it
    predict: float | None = None  # from start and goals to configurations or distributions
    optimize: float | None = None  # moving those towards the constraint

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not 0.0 <= value < np.inf:
                raise InvalidInputError(
                    f"timing {name!r} is {value}; give seconds, 0 or more, or None"
                )

    def __add__(self, other: "Timings") -> "Timings":
        """Sums of the parts; None where neither has one."""
        pairs = {name: (value, vars(other)[name]) for name, value in vars(self).items()}
        return Timings(
            **{
                name: None if a is b is None else (a or 0.0) + (b or 0.0)
                for name, (a, b) in pairs.items()
            }
        )

    @property
    def total(self) -> float:
        """Sum of all parts [s]."""
        return sum(value for value in vars(self).values() if value is not None)


@dataclass(frozen=True, eq=False)
class JointPath:
    """A motion: straight joint segments between states."""

    states: np.ndarray  # (m, n), m >= 2 [rad or m]

    def __repr__(self) -> str:
        return f"JointPath of {len(self.states)} states, {self.length:.2f} rad"

    @cached_property
    def length(self) -> float:
        """Length of the path, `sum_i |q_(i+1) - q_i|` [rad]."""
        return float(step_lengths(self.states).sum())

    def spaced(self, spacing: float) -> np.ndarray:
        """States (k, n), k >= 2, evenly along the path at most `spacing` [rad] apart, with ends."""
        return evenly_along(self.states, spacing)


@dataclass(frozen=True, eq=False)
class Tree:
    """A search tree with one or several roots."""

    nodes: np.ndarray  # (k, n) [rad or m]
    parent: np.ndarray  # (k,) index of each node's parent, -1 for roots


@dataclass(frozen=True, eq=False)
class PlanResult:
    """Outcome of one planner run."""

    status: PlanStatus
    path: JointPath | None  # None unless the status is SOLVED
    seconds: float  # wall time of the whole run, networks included
    counters: Counters
    vertices: int  # nodes in all trees
    sampler: str  # name of the distribution used
    trees: tuple[Tree, ...] = field(default=(), repr=False)
    detail: str = ""  # a few words more, e.g. about a failure
    # what found the path, and why, if that is not what the planner's name says; else ""
    fallback: str = ""
    timings: Timings = field(default_factory=Timings)  # which of the seconds were not search
    as_is: bool = False  # the path of an external planner, certified as it is

    def after(self, earlier: "PlanResult | None") -> "PlanResult":
        """This result of a run that searched before; seconds and counters are of the whole run."""
        if earlier is None:
            return self
        vertices, timings = earlier.vertices + self.vertices, earlier.timings + self.timings
        return replace(self, vertices=vertices, timings=timings)

    @property
    def search_seconds(self) -> float:
        """Wall time without that of `timings`."""
        return max(0.0, self.seconds - self.timings.total)
