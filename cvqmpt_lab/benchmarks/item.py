"""Items of a suite that are neither a plain problem nor a task: unsolvable, or in a map."""

from dataclasses import dataclass, replace

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import FailReason
from cvqmpt_lab.scene.scene import Scene


@dataclass(frozen=True)
class UnsolvableProblem:
    """An item for which no problem was found, and why."""

    name: str
    reason: str
    kind: FailReason = FailReason.NO_START  # what its rows are counted as


@dataclass(frozen=True)
class SensedProblem:
    """A problem in a map, and the scene that the map is of."""

    problem: PlanningProblem  # as planners are given it
    truth: Scene  # as it really is
    seconds: float  # from images in files to the problem [s]

    @property
    def name(self) -> str:
        """Name of the problem."""
        return self.problem.name

    @property
    def true_problem(self) -> PlanningProblem:
        """The same problem in the real scene."""
        return replace(self.problem, scene=self.truth)
