"""How rows name the phases of a task: ``TASK/NUMBER-PHASE``, as in ``3/5-carry``."""

from typing import NamedTuple

from cvqmpt_lab.errors import InvalidInputError

PAPER_PHASES = ("reach-handle", "reach-can", "carry")
"""The phases of the multi-sequence task whose times the paper's add up to, as far as can be inferred."""


class PhaseName(NamedTuple):
    """A planned phase: its task, its number among the planned ones from 1, its name."""

    task: str
    number: int
    phase: str


def phase_problem(task: str, number: int, phase: str) -> str:
    """Name of a phase's problem in rows."""
    return f"{task}/{number}-{phase}"


def split_problem(problem: str) -> PhaseName:
    """Inverse of `phase_problem`; InvalidInputError for rows of another kind."""
    task, slash, rest = problem.rpartition("/")
    number, dash, phase = rest.partition("-")
    if not (slash and dash and number.isdecimal()):
        raise InvalidInputError(f"problem {problem!r} is no phase of a task, such as 3/5-carry")
    return PhaseName(task, int(number), phase)
