"""Solutions as lines for people, or as plain data for json."""

from collections.abc import Iterator, Sequence
from typing import Any

from cvqmpt_lab.certificate.certificate import Certificate
from cvqmpt_lab.constraints.report import BoundUse, bound_usage
from cvqmpt_lab.planning.pipeline import Solution
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.anytime import Improvement
from cvqmpt_lab.search.result import PlanStatus

NEAR = 0.002  # [m]: a clearance below it is said to be small


def uses_of(solution: Solution) -> tuple[BoundUse, ...]:
    """How much of every bound of the constraint the path uses; of the start where there is none."""
    problem, shorter = solution.problem, solution.simplified
    states = problem.start[None] if shorter is None else shorter.path.states
    return bound_usage(problem.robot, problem.constraint, states)


def solution_lines(solution: Solution, planner: str, why: str = "") -> list[str]:
    """The lines a person reads; why: the planner was chosen, if nobody named it."""
    plan, shorter, problem = solution.plan, solution.simplified, solution.problem
    counts, certificate = plan.counters, solution.certificate
    uses = uses_of(solution)
    constraint = "; ".join(map(str, uses)) + (" at most" if shorter else " at the start")
    if not problem.constraint:
        constraint = "none: the hand may tilt and move as it likes"
    elif not uses:
        constraint = "all entries free"
    simplify = f", simplify {1e3 * shorter.seconds:.1f} ms" if shorter else ""
    lines = [
        f"problem     {problem.name}: robot {problem.robot.name}, {len(solution.goals)} goals",
        *_left_out(solution.left_out),
        f"constraint  {constraint}",
        f"planner     {planner}{why and f' ({why})'}, samples: {plan.sampler}",
        f"status      {_status(solution)}",
        f"time        goals {1e3 * solution.goal_seconds:.1f} ms, plan {1e3 * plan.seconds:.1f} "
        f"ms{simplify}",
    ]
    if not plan.as_is:
        lines.append(
            f"counts      {counts.projections} projections, {counts.newton_iterations} Newton "
            f"iterations, {counts.state_checks} state checks, {plan.vertices} vertices"
        )
    if plan.path is not None and shorter is not None:
        lines.append(
            f"length      {plan.path.length:.2f} rad, simplified {shorter.path.length:.2f} rad"
        )
    if solution.improvement is not None:
        lines.append(f"optimize    {_gain(solution.improvement)}")
    if certificate is not None:
        verdict, gaps = str(certificate.verdict), ", no gaps"
        if not certificate.valid:
            verdict, gaps = f"{verdict.upper()}: {'; '.join(certificate.reasons)}", ""
        lines.append(
            f"certificate {verdict} ({certificate.states_checked} states{gaps}, clearance "
            f"{_distances(certificate)})"
        )
        if certificate.valid and certificate.tolerated:
            lines.append(f"tolerates   {certificate.tolerated}")
    return lines


def _left_out(goals: Sequence[str], shown: int = 2) -> Iterator[str]:
    """Lines for the first goals that were left out, and how many more there are."""
    more = len(goals) - shown
    for number, text in enumerate(goals[:shown], start=1):
        rest = f"; and {more} more" if number == shown and more > 0 else ""
        yield f"left out    {text}{rest}"


def _distances(certificate: Certificate) -> str:
    """The least distances found, to obstacles and of the robot's own pieces."""
    parts = (
        ("obstacles", certificate.obstacle_clearance),
        ("self", certificate.self_clearance),
    )
    texts = [
        f"{what} {1e3 * part.distance_m:.1f} mm"
        # of obstacles also between what, where little remains
        + (f" (small: {part.pair})" if what == "obstacles" and part.distance_m < NEAR else "")
        for what, part in parts
        if part
    ]
    return ", ".join(texts) or f"{1e3 * certificate.min_clearance_m:.1f} mm"


def _gain(made: Improvement) -> str:
    """What `improve` used of its budget, and what it gained."""
    used, budget = f"{1e3 * made.seconds:.1f} ms", made.budget
    if budget.seconds is not None:
        used = f"{1e3 * made.seconds:.1f} of {1e3 * budget.seconds:g} ms"
    if budget.iterations is not None:
        used += f", {made.iterations} of {budget.iterations} iterations"
    (_, first), (_, last) = made.lengths[0], made.lengths[-1]
    gain = f"{first:.2f} to {last:.2f} rad ({made.gained:.0%} shorter)"
    return f"{used}: {made.searches} searches, {gain}"


def _status(solution: Solution) -> str:
    """How the plan ended, and by which method if not the one its name says."""
    plan = solution.plan
    how = f"{plan.status} by {plan.fallback}" if plan.fallback else str(plan.status)
    if plan.status in (PlanStatus.TIMEOUT, PlanStatus.ITERATION_LIMIT):
        how += (
            f": no path found within {plan.seconds:.3g} s and {plan.counters.iterations} iterations"
        )
    return f"{how} ({plan.detail})" if plan.detail else how


def solution_data(
    solution: Solution, planner: str, why: str = "", asked: PlanningProblem | None = None
) -> dict[str, Any]:
    """`solution` for json, with states and certificate; asked: problem before goals were drawn."""
    plan, shorter = solution.plan, solution.simplified
    problem, more = solution.problem, solution.improvement
    certificate = None
    if shorter is not None and solution.certificate is not None:
        # these need scipy.interpolate, half a second to import
        from cvqmpt_lab.certificate.motion_check import DryRun
        from cvqmpt_lab.certificate.record import record
        from cvqmpt_lab.trajectory.trajectory import Motion

        asked, states = asked or problem, shorter.path.states
        motion = Motion(asked.robot.joint_names, states)
        certificate = record(asked, motion, DryRun(solution.certificate, states))
    return {
        "problem": problem.name,
        "robot": problem.robot.name,
        "joints": list(problem.robot.joint_names),
        "goals": len(solution.goals),
        "goals_left_out": list(solution.left_out),
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
        "certificate": certificate,
        "path": shorter.path.states.tolist() if shorter else None,
    }
