"""What planners take and give back: budgets, statuses, counters, timings, paths."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from cvqmpt_lab.errors import InvalidInputError


class PlanStatus(StrEnum):
    """How a planning run ended. Everything but SOLVED is a failure with that reason."""

    SOLVED = "solved"
    TIMEOUT = "timeout"
    ITERATION_LIMIT = "iteration_limit"
    NO_GOAL = "no_goal"
    INVALID_START = "invalid_start"
    INVALID_GOAL = "invalid_goal"
    PLANNER_ERROR = "planner_error"


@dataclass(frozen=True)
class Budget:
    """When to give up: after seconds, after iterations (bit-for-bit repeatable), or whichever is first."""

    seconds: float | None = None
    iterations: int | None = None

    def __post_init__(self) -> None:
        if self.seconds is None and self.iterations is None:
            raise InvalidInputError("a budget needs seconds, iterations or both")
        for name in ("seconds", "iterations"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InvalidInputError(f"budget {name} must be positive, not {value}")


@dataclass(frozen=True)
class Counters:
    """Work done, in machine-independent units."""

    projections: int = 0
    newton_iterations: int = 0
    state_checks: int = 0
    iterations: int = 0


@dataclass(frozen=True)
class Timings:
    """Parts of a planning run that are not search [s]; None where a planner has no such part.

    Attributes
    ----------
    encode: from the point cloud to what the network keeps of it.
    predict: from start and goals to configurations or distributions. optimize: moving those.
    """

    encode: float | None = None
    predict: float | None = None
    optimize: float | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not 0.0 <= value < np.inf:
                raise InvalidInputError(f"timing {name!r} is {value}; give seconds, 0 or more, or None")

    @property
    def total(self) -> float:
        """Their sum [s]."""
        return sum(value for value in vars(self).values() if value is not None)


@dataclass(frozen=True, eq=False)
class Path:
    """A motion: straight joint segments between states (m, n), m >= 2 [rad or m]."""

    states: np.ndarray

    @property
    def length(self) -> float:
        """Sum of Euclidean distances between neighbouring states [rad]."""
        return float(np.linalg.norm(np.diff(self.states, axis=0), axis=1).sum())

    def spaced(self, spacing: float) -> np.ndarray:
        """States (k, n), k >= 2, evenly along the path and at most `spacing` [rad] of it apart, ends included."""
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.states, axis=0), axis=1))])
        marks = np.linspace(0.0, along[-1], max(2, int(np.ceil(along[-1] / spacing)) + 1))
        return np.stack([np.interp(marks, along, joint) for joint in self.states.T], axis=1)

    def reversed(self) -> "Path":
        """The same motion backwards."""
        return Path(self.states[::-1].copy())


@dataclass(frozen=True, eq=False)
class Tree:
    """Nodes (k, n) and the index of each one's parent (k,), -1 for roots."""

    nodes: np.ndarray
    parent: np.ndarray


@dataclass(frozen=True, eq=False)
class PlanResult:
    """Outcome of one planner run; path is None unless status is SOLVED.

    Attributes
    ----------
    seconds: wall time of the whole run, networks included. vertices: nodes in all trees. sampler: name of the
        distribution used.
    detail: one line more, e.g. about a failure, or "".
    fallback: why the path did not come the way the planner's name promises, or "".
    timings: which of the seconds were not search.
    """

    status: PlanStatus
    path: Path | None
    seconds: float
    counters: Counters
    vertices: int
    sampler: str
    trees: tuple[Tree, ...] = field(default=())
    detail: str = ""
    fallback: str = ""
    timings: Timings = field(default_factory=Timings)

    @property
    def search_seconds(self) -> float:
        """Wall time without that of `timings`."""
        return max(0.0, self.seconds - self.timings.total)
