"""Problems of the place task and of held-out families without a constraint."""

from dataclasses import replace

from cvqmpt_lab.benchmarks.family_task import held_out_problem
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import phase_problem
from cvqmpt_lab.scene.families import FAMILIES


def unconstrained_problem(index: int) -> PlanningProblem | UnsolvableProblem:
    """Problem `index` of the place task (below 60), or of the families in turn (from 60 on).

    Its rows are named by index and group: kitchen or families.
    """
    if index < 60:
        group, found = (1, "kitchen"), place_problem(index)
    else:
        turn, family = divmod(index - 60, len(FAMILIES))
        group, found = (2, "families"), held_out_problem(tuple(FAMILIES)[family], turn)
    if isinstance(found, PlanningProblem):
        found = found.changed(constraint=())
    return replace(found, name=phase_problem(str(index), *group))
