"""Solved tasks as lines for people, or as plain data for json."""

from collections.abc import Iterator
from typing import Any

from cvqmpt_lab.codec import to_plain
from cvqmpt_lab.solution_report import solution_data
from cvqmpt_lab.tasks.solve import PhaseOutcome, TaskSolution
from cvqmpt_lab.tasks.task import PHASES, Phase, PlannedPhase


def steps_of(solution: TaskSolution) -> Iterator[tuple[Phase, PhaseOutcome | None]]:
    """The phases in order, planned ones with their outcome, up to the one that failed."""
    outcomes = {outcome.phase.name: outcome for outcome in solution.outcomes}
    for phase in solution.task.phases:
        if isinstance(phase, PlannedPhase) and phase.name not in outcomes:
            return
        yield phase, outcomes.get(phase.name)


def event_of(phase: Phase) -> dict[str, Any]:
    """Name and kind of a phase, and what the gripper does in it."""
    kind = next(kind for kind, made in PHASES.items() if type(phase) is made)
    plain = to_plain(phase)
    event = {key: plain[key] for key in ("articulation", "object", "gripper") if key in plain}
    return {"phase": phase.name, "kind": kind, **event}


def task_data(solution: TaskSolution, planner: str) -> dict[str, Any]:
    """Plain data for json: the phases in order, planned ones as `solution_data` has them."""
    phases = []
    for phase, outcome in steps_of(solution):
        said = event_of(phase)
        if outcome is not None:
            seconds = outcome.trajectory and outcome.trajectory.duration
            more = {
                "attempts": len(outcome.attempts),
                "duration_s": seconds,
                "reason": outcome.reason,
            }
            said |= more | solution_data(outcome.solution, planner)
            said |= {"solved": outcome.solved, "fallback": outcome.fallback or said["fallback"]}
        phases.append(said)
    whole = {"task": solution.task.name, "planner": planner, "solved": solution.solved}
    return {**whole, "failure": solution.failure, "phases": phases}


def task_lines(solution: TaskSolution, planner: str) -> list[str]:
    """The lines a person reads."""
    lines = [f"task        {solution.task.name}, planner {planner}"]
    planning = execution = 0.0
    for outcome in solution.outcomes:
        goals = sum(attempt.goal_seconds for attempt in outcome.attempts)
        search = sum(attempt.plan.seconds for attempt in outcome.attempts)
        simplify = sum(
            attempt.simplified.seconds for attempt in outcome.attempts if attempt.simplified
        )
        planning += goals + search + simplify
        line = (
            f"{outcome.phase.name:15} goals {1e3 * goals:.0f} ms, plan {1e3 * search:.0f} ms, "
            f"simplify {1e3 * simplify:.0f} ms"
        )
        if len(outcome.attempts) > 1:
            line += f" in {len(outcome.attempts)} attempts"
        if outcome.trajectory is not None:
            execution += outcome.trajectory.duration
            line += f", certified, {outcome.trajectory.duration:.1f} s of motion"
        lines.append(line + (f" ({outcome.fallback})" if outcome.fallback else ""))
    if solution.solved:
        return [*lines, f"solved      planning {planning:.2f} s, execution {execution:.1f} s"]
    return [*lines, f"FAILED      {solution.failure}"]
