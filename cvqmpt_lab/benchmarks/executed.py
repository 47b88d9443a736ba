"""Motions of the place task with the can, and tasks, that are executed in a physics simulation."""

from cvqmpt_lab.benchmarks.item import ExecutedProblem, Solvable, UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import multi_sequence_task, place_problem
from cvqmpt_lab.results.row import phase_problem


def executed_problem(index: int) -> ExecutedProblem | UnsolvableProblem:
    """Return motion or task number index // 2, at full speed (even index) or half speed (odd).

    Numbers below 50 are motions; task k has number 50 + k.

    Each is executed by two controllers; one of them does not know the load in the hand.
    """
    motions = 50  # larger numbers are tasks
    number, at_half_speed = divmod(index, 2)
    speed = 0.5 if at_half_speed else 1.0
    if number < motions:
        kind, first_group = "motion", 1
        problem: Solvable | UnsolvableProblem = place_problem(number, with_can=True)
    else:
        kind, first_group = "task", 5
        problem = multi_sequence_task(number - motions)
    if isinstance(problem, UnsolvableProblem):
        return UnsolvableProblem(str(index), problem.reason, problem.kind)
    kind = f"{kind}, speed {speed:g}"
    group = first_group + 2 * at_half_speed
    controllers = {
        phase_problem(str(index), group, kind): "computed-torque",
        phase_problem(str(index), group + 1, f"{kind}, load unknown"): (
            "computed-torque-unknown-load"
        ),
    }
    return ExecutedProblem(str(index), problem, speed, controllers)
