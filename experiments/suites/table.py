"""The suites by name: which problems an experiment runs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.attachment import Attachment
from cvqmpt_lab.scene.families import FAMILIES
from experiments.suites.family_task import PROBLEMS as FAMILY_PROBLEMS
from experiments.suites.family_task import family_problem
from experiments.suites.place_task import ENVIRONMENTS, UnsolvableProblem, carried_can, place_problem


@dataclass(frozen=True)
class Suite:
    """A named, ordered set of problems; make(i) builds the one with index i."""

    name: str
    problems: Sequence[int]
    make: Callable[[int], PlanningProblem | UnsolvableProblem]
    summary: str
    carried: tuple[Attachment, ...] = ()
    """What the hand is shown with in pictures, where its problems do not model it."""

    def problem(self, index: int) -> PlanningProblem | UnsolvableProblem:
        """Problem `index`; InvalidInputError names the valid range."""
        if index not in self.problems:
            raise InvalidInputError(
                f"unknown problem {index} of suite {self.name}; valid indices: "
                f"{self.problems[0]} to {self.problems[-1]}"
            )
        return self.make(index)


SUITES: Mapping[str, Suite] = {
    suite.name: suite
    for suite in (
        Suite(
            "place-task",
            ENVIRONMENTS,
            place_problem,
            "carry a can to the shelf upright; can not modelled",
            (carried_can(),),
        ),
        Suite(
            "place-task-with-can",
            ENVIRONMENTS,
            partial(place_problem, with_can=True),
            "the same with the carried can as part of the robot",
        ),
        *(
            Suite(
                f"family-{family}",
                FAMILY_PROBLEMS,
                partial(family_problem, family),
                f"between upright hand poses in held-out scenes of the family {family}",
            )
            for family in FAMILIES
        ),
    )
}


def suite_named(name: str) -> Suite:
    """The suite of that name; UnknownChoiceError lists the names."""
    if name not in SUITES:
        raise UnknownChoiceError("suite", name, SUITES)
    return SUITES[name]
