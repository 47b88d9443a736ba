"""Items of suites other than problems and tasks: unsolvable, sensed, executed ones, and phases."""

from collections.abc import Mapping
from dataclasses import dataclass

from cvqmpt_lab.benchmarks.results.row import FailReason
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Scene


@dataclass(frozen=True)
class UnsolvableProblem:
    """Item of a suite for which no problem could be made."""

    name: str
    reason: str  # text for readers
    kind: FailReason = FailReason.NO_START  # reason of failure in its rows


@dataclass(frozen=True)
class SensedProblem:
    """Problem whose scene is a map made from depth images, and the real scene."""

    problem: PlanningProblem  # given to planners: its scene is the map
    truth: Scene  # real scene of the images
    seconds: float  # time to make the problem from image files [s]

    @property
    def name(self) -> str:
        """Name of the problem."""
        return self.problem.name


Solvable = PlanningProblem | Task


@dataclass(frozen=True)
class ExecutedProblem:
    """Problem or task whose motion is executed in a physics simulation."""

    name: str
    problem: Solvable
    speed: float  # share of the joint limits that the motion uses
    # controller by the name of its row
    controllers: Mapping[str, str]


@dataclass(frozen=True)
class Phases:
    """Phases of a task that are problems of their own, each planned whether others fail or not."""

    name: str  # name of the task
    problems: Mapping[str, PlanningProblem]  # by name of the phase, in order


SuiteItem = Solvable | UnsolvableProblem | SensedProblem | ExecutedProblem | Phases
