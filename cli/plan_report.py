"""What `cvqmpt plan` says of a solution: lines for people, or one json object for programs."""

import json
from collections.abc import Sequence
from typing import Any

from cvqmpt_lab.constraints.report import BoundUse, bound_usage
from cvqmpt_lab.files import finite
from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.anytime import Improvement
from cvqmpt_lab.search.result import PlanStatus


def uses_of(solution: Solution) -> tuple[BoundUse, ...]:
    """How much of every bound of the constraint the path found uses;
    of the start where there is no path.
    """
    problem, shorter = solution.problem, solution.simplified
    states = problem.start[None] if shorter is None else shorter.path.states
    return bound_usage(problem.robot, problem.constraint, states)


def report(solution: Solution, planner: str, why: str = "") -> list[str]:
    """The lines a person reads; why: the planner was chosen, if nobody named it."""
    plan, shorter = solution.plan, solution.simplified
    counts = plan.counters
    lines = [
        f"problem     {solution.problem.name}: robot {solution.problem.robot.name}, "
        f"{len(solution.problem.goals)} goals",
        f"constraint  {_constraint(solution.problem, uses_of(solution), shorter is not None)}",
        f"planner     {planner}{why and f' ({why})'}, samples: {plan.sampler}",
        f"status      {_status(solution)}",
        f"time        goals {1e3 * solution.goal_seconds:.1f} ms, plan {1e3 * plan.seconds:.1f} ms"
        + (f", simplify {1e3 * shorter.seconds:.1f} ms" if shorter else ""),
    ]
    if not plan.as_is:
        lines.append(
            f"counts      {counts.projections} projections, {counts.newton_iterations} Newton "
            f"iterations, "
            f"{counts.state_checks} state checks, {plan.vertices} vertices"
        )
    if plan.path is not None and shorter is not None:
        lines.append(
            f"length      {plan.path.length:.2f} rad, simplified {shorter.path.length:.2f} rad"
        )
    if solution.improvement is not None:
        lines.append(f"optimize    {_gain(solution.improvement)}")
    if solution.certificate is not None:
        lines.append(f"certificate {_verdict(solution)}")
    return lines


def _gain(made: Improvement) -> str:
    """How much of the time for it was used, and what was gained."""
    used, budget = f"{1e3 * made.seconds:.1f}", made.budget
    used += " ms" if budget.seconds is None else f" of {1e3 * budget.seconds:g} ms"
    used += (
        ""
        if budget.iterations is None
        else f", {made.iterations} of {budget.iterations} iterations"
    )
    (_, first), (_, last) = made.lengths[0], made.lengths[-1]
    gain = f"{first:.2f} to {last:.2f} rad ({made.gained:.0%} shorter)"
    return f"{used}: {made.searches} searches, {gain}"


def _status(solution: Solution) -> str:
    """How the plan ended, and by what if not by what the planner's name promises."""
    plan = solution.plan
    how = f"{plan.status} by {plan.fallback}" if plan.fallback else str(plan.status)
    if plan.status in (PlanStatus.TIMEOUT, PlanStatus.ITERATION_LIMIT):
        how += (
            f": no path found within {plan.seconds:.3g} s and {plan.counters.iterations} iterations"
        )
    return f"{how} ({plan.detail})" if plan.detail else how


def _constraint(problem: PlanningProblem, uses: Sequence[BoundUse], has_path: bool) -> str:
    """Largest value of every bounded entry against its bound."""
    if not problem.constraint:
        return "none: the hand may tilt and move as it likes"
    if not uses:
        return "all entries free"
    return "; ".join(map(str, uses)) + (" at most" if has_path else " at the start")


def _verdict(solution: Solution) -> str:
    certificate = solution.certificate
    assert certificate is not None
    verdict = str(certificate.verdict)
    if not certificate.valid:
        verdict = f"{verdict.upper()}: {'; '.join(certificate.reasons)}"
    seen = f"{certificate.states_checked} states{', no gaps' if certificate.valid else ''}"
    return f"{verdict} ({seen}, clearance {1e3 * certificate.min_clearance_m:.1f} mm)"


def as_json(data: dict[str, Any]) -> str:
    """Json text; undefined numbers are null."""
    return json.dumps(finite(data), indent=1, allow_nan=False)


def solution_data(
    solution: Solution, planner: str, why: str = "", asked: PlanningProblem | None = None
) -> dict[str, Any]:
    """The same as plain data for json, with the path's states; asked:
    the problem before goals were drawn.
    """
    plan, shorter = solution.plan, solution.simplified
    problem, more = solution.problem, solution.improvement
    return {
        "problem": problem.name,
        "robot": problem.robot.name,
        "joints": list(problem.robot.joint_names),
        "goals": len(problem.goals),
        "constraint": [vars(use) for use in uses_of(solution)],
        "planner": planner,
        "chosen_because": why,
        "sampler": plan.sampler,
        "status": str(plan.status),
        "fallback": plan.fallback,
        "detail": plan.detail,
        "solved": solution.solved,
        "seconds": {
            "goals": solution.goal_seconds,
            "observe": solution.observe_seconds,
            "encode": plan.timings.encode,
            "predict": plan.timings.predict,
            "optimize": plan.timings.optimize,
            "search": plan.search_seconds,
            "simplify": shorter.seconds if shorter else None,
        },
        "counts": None if plan.as_is else vars(plan.counters) | {"vertices": plan.vertices},
        "length_rad": shorter.path.length if shorter else None,
        "optimize": more and vars(more) | {"budget": vars(more.budget), "gained": more.gained},
        "certificate": _record(solution, asked or solution.problem),
        "path": shorter.path.states.tolist() if shorter else None,
    }


def _record(solution: Solution, problem: PlanningProblem) -> dict[str, Any] | None:
    """The certificate of its path as `cvqmpt certify --json` prints it; None without a path."""
    # these need scipy.interpolate, half a second to import
    from cvqmpt_lab.certificate_record import record
    from cvqmpt_lab.motion_check import DryRun
    from cvqmpt_lab.trajectory.trajectory import Motion

    if solution.simplified is None or solution.certificate is None:
        return None
    states = solution.simplified.path.states
    motion = Motion(problem.robot.joint_names, states)
    return record(problem, motion, DryRun(solution.certificate, states))
