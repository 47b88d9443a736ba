"""The suites by name: which problems or tasks an experiment runs.

A folder of problem files is one by its path.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.planners import PLANNERS, WITHOUT_WEIGHTS, Method
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import SLOW
from cvqmpt_lab.scene.families import FAMILIES
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.tasks.task import Task
from experiments.suites.constraint_task import PROBLEMS as CONSTRAINED
from experiments.suites.constraint_task import constraint_problem
from experiments.suites.door_task import PROBLEMS as DOOR_PROBLEMS
from experiments.suites.door_task import door_problem
from experiments.suites.factorial import PLANNERS as FACTORIAL
from experiments.suites.family_task import PROBLEMS as FAMILY_PROBLEMS
from experiments.suites.family_task import ROBOT_PROBLEMS, ROBOTS, held_out_problem, robots_problem
from experiments.suites.multi_sequence import TASKS, multi_sequence_task
from experiments.suites.place_task import (
    ENVIRONMENTS,
    MIRRORED_ENVIRONMENTS,
    SINGLE_GOAL_ENVIRONMENTS,
    UnsolvableProblem,
    carried_can,
    mirrored_problem,
    place_problem,
    single_goal_problem,
)
from experiments.suites.problem_folder import read_folder
from experiments.suites.sensor_task import (
    SCENES,
    VARIED_PLANNERS,
    VARIED_PROBLEMS,
    SensedProblem,
    robustness_problem,
    sensor_problem,
)

# for problems that no shipped weights fit, and for constraints that no model has seen
FREE_OF_WEIGHTS = tuple(name for name in PLANNERS if name in WITHOUT_WEIGHTS)
IN_A_NEW_KITCHEN = (
    "birrt",
    "ompl-projected",
    "cvq-mpt",
    "opt-cvq-mpt",
    "cvq-wide",
    "roadmap",
    "roadmap-cvq",
)
ON_ANY_ROBOT = ("birrt", "ompl-projected", "roadmap")
# the last three are entry points, see `experiments.peers`
WITH_PEERS = ("birrt", "roadmap", "roadmap-cvq", "roboplan", "sscbirrt", "hpp")
ZERO_SHOT = ("birrt", "ompl-projected", "cvq-mpt", "opt-cvq-mpt", "roadmap-cvq")

SuiteItem = PlanningProblem | UnsolvableProblem | SensedProblem | Task


@dataclass(frozen=True)
class Suite:
    """A named, ordered set of problems or tasks; make(i) builds the one with index i."""

    name: str
    problems: Sequence[Any]  # indices, or names of the problems of a folder
    make: Callable[[Any], SuiteItem]
    planners: Sequence[str] = tuple(PLANNERS)  # run unless others are named
    # in the hand in pictures, where its problems do not model it
    carried: tuple[Attachment, ...] = ()
    # every planner computes its own distance field and edge costs of a cloud
    new_scenes: bool = False
    # what else decides its rows, as json values
    settings: Mapping[str, object] = field(default_factory=dict)
    # sha256 of a folder's problems, by name
    digests: Mapping[str, str] = field(default_factory=dict)

    def item(self, index: int | str) -> SuiteItem:
        """Problem or task `index`; InvalidInputError names the valid range."""
        if index not in self.problems:
            raise InvalidInputError(
                f"unknown problem {index} of suite {self.name}; valid indices: "
                f"{self.problems[0]} to {self.problems[-1]}"
            )
        return self.make(index)

    def solvable(self, index: int | str) -> PlanningProblem | Task:
        """The same, of a scanned scene the problem in its map;
        InvalidInputError where there is no problem.
        """
        item = self.item(index)
        if isinstance(item, UnsolvableProblem):
            raise InvalidInputError(
                f"problem {index} of {self.name} has no solution: {item.reason}"
            )
        return item.problem if isinstance(item, SensedProblem) else item


SUITES: Mapping[str, Suite] = {
    suite.name: suite
    for suite in (
        Suite("place-task", ENVIRONMENTS, place_problem, carried=(carried_can(),), new_scenes=True),
        Suite(
            "place-task-with-can",
            ENVIRONMENTS,
            partial(place_problem, with_can=True),
            new_scenes=True,
        ),
        Suite(
            "place-task-single-goal",
            SINGLE_GOAL_ENVIRONMENTS,
            single_goal_problem,
            carried=(carried_can(),),
            new_scenes=True,
        ),
        Suite(
            "place-task-mirrored",
            MIRRORED_ENVIRONMENTS,
            mirrored_problem,
            IN_A_NEW_KITCHEN,
            carried=(carried_can(),),
            new_scenes=True,
        ),
        *(
            Suite(
                f"family-{name}", FAMILY_PROBLEMS, partial(held_out_problem, name), new_scenes=True
            )
            for name in FAMILIES
        ),
        Suite("constraints", CONSTRAINED, constraint_problem, ZERO_SHOT, new_scenes=True),
        Suite("factorial", ENVIRONMENTS[:60], place_problem, FACTORIAL, new_scenes=True),
        Suite(
            "factorial-constraints",
            CONSTRAINED[:80],
            constraint_problem,
            FACTORIAL,
            new_scenes=True,
        ),
        Suite("open-door", DOOR_PROBLEMS, door_problem, FREE_OF_WEIGHTS),
        Suite(
            "robots",
            range(len(ROBOTS) * len(ROBOT_PROBLEMS)),
            robots_problem,
            ON_ANY_ROBOT,
            new_scenes=True,
        ),
        Suite(
            "peers",
            SINGLE_GOAL_ENVIRONMENTS,
            single_goal_problem,
            WITH_PEERS,
            carried=(carried_can(),),
        ),
        Suite("sensor", SCENES, sensor_problem, new_scenes=True),
        Suite(
            "sensor-robustness",
            VARIED_PROBLEMS,
            robustness_problem,
            VARIED_PLANNERS,
            new_scenes=True,
        ),
        Suite("multi-sequence", TASKS, multi_sequence_task, settings={"speed": SLOW}),
    )
}


_FOLDERS: dict[str, Suite] = {}  # by full path; workers that are forked find what was read before


def folder_suite(folder: Path) -> Suite:
    """The problems of a folder as they are now, as a suite with the folder's name; `suite_named`
    finds it by full path.

    Its planners are those that can serve all of them. InvalidInputError: see `read_folder`; or the
    name is taken.
    """
    found, path = read_folder(folder), folder.resolve()
    if path.name in SUITES or not path.name:
        raise InvalidInputError(
            f"folder {path}: its rows would be called {path.name!r}, as a suite of ours; give it "
            f"another name"
        )
    problems = {name: filed.problem for name, filed in found.items()}
    _FOLDERS[str(path)] = suite = Suite(
        path.name,
        tuple(problems),
        problems.__getitem__,
        tuple(name for name, method in PLANNERS.items() if _serves_all(method, problems.values())),
        new_scenes=True,
        digests={name: filed.digest for name, filed in found.items()},
    )
    return suite


def _serves_all(method: Method, problems: Iterable[PlanningProblem]) -> bool:
    return not any(method.incompatibility(problem) for problem in problems)


def suite_named(name: str) -> Suite:
    """The suite of that name, or of the folder with that full path;
    UnknownChoiceError lists the names.
    """
    if os.sep in name:
        return _FOLDERS.get(name) or folder_suite(Path(name))
    if name not in SUITES:
        raise UnknownChoiceError("suite", name, SUITES)
    return SUITES[name]
