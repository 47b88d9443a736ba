"""The result of a planning run: status, path, counts, times."""

from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from numbers import Real
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, require_kind, shown, whole_number
from cvqmpt_lab.base.polyline import evenly_along, step_lengths
from cvqmpt_lab.search.work import PRICES, Prices, search_work


class PlanStatus(StrEnum):
    """Result of a planning run; everything but SOLVED is a failure.

    `FaultKind` names the faults of a path, `FailReason` joins both for result rows.
    """

    SOLVED = "solved"
    TIMEOUT = "timeout"
    ITERATION_LIMIT = "iteration_limit"
    COST_LIMIT = "cost_limit"
    NO_GOAL = "no_goal"
    INVALID_START = "invalid_start"
    INVALID_GOAL = "invalid_goal"
    # only from external planners
    PLANNER_ERROR = "planner_error"
    MALFORMED_PATH = "malformed_path"
    OVERTIME = "overtime"
    NO_PATH = "no_path"  # it returned no path within the budget


@dataclass(frozen=True)
class Budget:
    """Limit of a search in seconds, iterations or cost, or several: the first one ends it.

    Without seconds, results repeat bit for bit.
    """

    seconds: float | None = None
    iterations: int | None = None
    cost: float | None = None  # price of state checks, projections and Newton steps [s]
    prices: Prices = PRICES["published"]

    def __post_init__(self) -> None:
        if self.seconds is None and self.iterations is None and self.cost is None:
            raise InvalidInputError("a budget needs seconds, iterations or both, or a cost")
        if self.iterations is not None:
            # json represents larger numbers inexactly
            whole = whole_number("budget iterations", self.iterations, 1, 2**53)
            object.__setattr__(self, "iterations", whole)
        for name in ("seconds", "cost"):
            value: Any = getattr(self, name)
            if value is not None and not (isinstance(value, Real) and float(value) > 0.0):
                raise InvalidInputError(f"budget {name} {shown(value)}: give a number above 0")

    def share(self, fraction: float) -> "Budget":
        """Return a fraction of this budget, at least one iteration."""
        count = self.iterations
        return replace(
            self,
            seconds=None if self.seconds is None else fraction * self.seconds,
            iterations=None if count is None else max(1, round(fraction * count)),
            cost=None if self.cost is None else fraction * self.cost,
        )

    def within(self, other: "Budget") -> "Budget":
        """Return the smaller limits of both budgets, with the prices of this one."""
        smaller: dict[str, Any] = {}
        for name in ("seconds", "iterations", "cost"):
            limits = [getattr(budget, name) for budget in (self, other)]
            smaller[name] = min((x for x in limits if x is not None), default=None)
        return replace(self, **smaller)

    @classmethod
    def require(cls, value: Any, what: str = "budget") -> None:
        """Refuse anything but a budget; `what` is its name in the error message."""
        cure = "give Budget(seconds=...), Budget(iterations=...) or both in one"
        require_kind(what, value, cls, cure)


@dataclass(frozen=True)
class Counters:
    """Numbers of operations, which do not depend on the machine."""

    projections: int = 0
    newton_iterations: int = 0
    state_checks: int = 0
    iterations: int = 0
    # clearances read from a distance grid; they guide the search and are no collision checks
    clearances: int = 0
    extensions: int = 0  # number of tree extensions that added at least one node
    # parts of `projections` and `newton_iterations`: projections of draws
    draw_projections: int = 0
    draw_newton_iterations: int = 0

    def __add__(self, other: "Counters") -> "Counters":
        """Sum of each count."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Counters(*(a + b for a, b in pairs))

    @property
    def work(self) -> float:
        """`projections + state checks + CLEARANCE_COST * clearances`."""
        return search_work(self.projections, self.state_checks, self.clearances)

    def cost(self, prices: Prices) -> float:
        """Return the price of state checks, projections and Newton steps [s]."""
        return prices.cost(self.state_checks, self.projections, self.newton_iterations)


@dataclass(frozen=True)
class Timings:
    """Times of the parts of a planning run before the search [s]; None: there is no such part."""

    encode: float | None = None  # point cloud to scene embedding
    predict: float | None = None  # start and goals to configurations or distributions
    optimize: float | None = None  # latent update towards the constraint

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not 0.0 <= value < np.inf:
                raise InvalidInputError(
                    f"timing {name!r} is {value}; give seconds, 0 or more, or None"
                )

    def __add__(self, other: "Timings") -> "Timings":
        """Sum of each part; None where both are None."""
        sums: dict[str, float | None] = {}
        for name, own in vars(self).items():
            more = vars(other)[name]
            sums[name] = None if own is None and more is None else (own or 0.0) + (more or 0.0)
        return Timings(**sums)

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
        """Return evenly spaced states (k, n) from start to end, at most `spacing` [rad] apart."""
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
    vertices: int  # number of nodes of all trees and roadmaps; OMPL's planners: what OMPL stores
    sampler: str  # name of the sampling distribution
    trees: tuple[Tree, ...] = field(default=(), repr=False)
    detail: str = ""  # short remark, for example about a failure
    # another method than the planner's name says that found the path, and the reason; else ""
    fallback: str = ""
    timings: Timings = field(default_factory=Timings)  # parts of `seconds` before the search
    as_is: bool = False  # path of an external planner: it is certified without shortening
    direct: bool = False  # the direct motion to a goal: it is not shortened
    goals_tried: int = 1  # number of searches for one goal each; 1 where all are searched at once
    roots: int = 0  # number of starts and goals of all trees
    # states of the path that the search stored (m, n); None: the path's states
    waypoints: np.ndarray | None = field(default=None, repr=False)

    def after(self, earlier: "PlanResult | None") -> "PlanResult":
        """Return this result with the vertices, roots and timings of an earlier search added.

        Seconds and counters cover the whole run already.
        """
        if earlier is None:
            return self
        vertices, timings = earlier.vertices + self.vertices, earlier.timings + self.timings
        return replace(self, vertices=vertices, timings=timings, roots=earlier.roots + self.roots)

    @property
    def counted(self) -> Counters | None:
        """The counts; None where an external planner neither called ours nor reported any."""
        return None if self.as_is and self.counters == Counters() else self.counters

    @property
    def search_seconds(self) -> float:
        """Wall time of the search [s], without `timings`."""
        return max(0.0, self.seconds - self.timings.total)
