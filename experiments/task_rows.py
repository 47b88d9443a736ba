"""From the solution of a task to result rows: one for each planned phase."""

from dataclasses import replace
from typing import Any

from cvqmpt_lab.results.store import ResultRow
from cvqmpt_lab.tasks.solve_task import PhaseOutcome, TaskSolution
from cvqmpt_lab.tasks.task import PlannedPhase
from experiments.rows import result_row
from paper_tables.phases_summary import phase_problem

SUMMED = (
    *("t_total_s", "t_goals_s", "t_encode_s", "t_predict_s", "t_optimize_s", "t_plan_s", "t_simplify_s"),
    *("n_projections", "n_newton_iterations", "n_state_checks", "n_iterations", "vertices"),
)


def phase_rows(suite: str, planner: str, seed: int, backend: str, solution: TaskSolution) -> list[ResultRow]:
    """Rows of all planned phases, named by `phase_problem`; those after a failed one are failures too."""
    planned = [phase.name for phase in solution.task.phases if isinstance(phase, PlannedPhase)]
    outcomes = {outcome.phase.name: outcome for outcome in solution.outcomes}
    rows = []
    for number, name in enumerate(planned, start=1):
        problem = phase_problem(solution.task.name, number, name)
        if name in outcomes:
            rows.append(phase_row(suite, problem, planner, seed, backend, outcomes[name]))
        else:
            rows.append(
                ResultRow(
                    suite=suite,
                    problem=problem,
                    planner=planner,
                    seed=seed,
                    backend=backend,
                    status="not_reached",
                    fail_reason=solution.failure,
                    solved=False,
                )
            )
    return rows


def phase_row(
    suite: str, problem: str, planner: str, seed: int, backend: str, outcome: PhaseOutcome
) -> ResultRow:
    """The row of the last attempt, with time and work of all attempts.

    ``sampler_used`` says when another planner took over.
    """
    rows = [
        result_row(suite, planner, seed, backend, attempt, attempt.goal_seconds)
        for attempt in outcome.attempts
    ]
    last = rows[-1]
    sums: dict[str, Any] = {}
    for column in SUMMED:
        values = [getattr(row, column) for row in rows if getattr(row, column) is not None]
        sums[column] = sum(values) if values else None
    sampler = f"{last.sampler_used} ({outcome.fallback})" if outcome.fallback else last.sampler_used
    return replace(
        last,
        problem=problem,
        sampler_used=sampler,
        status="not_timed" if last.solved and not outcome.solved else last.status,
        fail_reason=None if outcome.solved else " ".join((outcome.reason or last.status).split()),
        solved=outcome.solved,
        execution_time_s=outcome.trajectory.duration if outcome.trajectory else None,
        **sums,
    )
