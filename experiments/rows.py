"""From a solution to a result row: what is measured of one run."""

import hashlib

import numpy as np

from cvqmpt_lab.pipeline import Solution
from cvqmpt_lab.planning.result import Path, PlanStatus
from cvqmpt_lab.results.store import ResultRow


def path_hash(path: Path) -> str:
    """sha256 of the states' bytes: equal for bit-for-bit equal paths."""
    return hashlib.sha256(np.ascontiguousarray(path.states, dtype=np.float64).tobytes()).hexdigest()


def result_row(
    suite: str, planner: str, seed: int, backend: str, solution: Solution, goal_seconds: float
) -> ResultRow:
    """One row of runs.csv; goal_seconds is charged to the planner, undefined values stay empty.

    The total is the sum of its parts: goals, encoding, prediction, optimization, search and simplification.
    """
    plan, shorter, certificate = solution.plan, solution.simplified, solution.certificate
    timings, search = plan.timings, plan.search_seconds
    total = goal_seconds + timings.total + search + (shorter.seconds if shorter else 0.0)
    reason = "; ".join(certificate.reasons) if certificate and certificate.reasons else plan.detail
    status = plan.status if certificate is None or certificate.valid else "uncertified"
    return ResultRow(
        suite=suite,
        problem=solution.problem.name,
        planner=planner,
        sampler_used=plan.sampler,
        seed=seed,
        backend=backend,
        status=str(status),
        fail_reason=None if solution.solved else reason or str(status),
        solved=solution.solved,
        certified=certificate.valid if certificate else None,
        t_total_s=total,
        t_goals_s=goal_seconds,
        t_encode_s=timings.encode,
        t_predict_s=timings.predict,
        t_optimize_s=timings.optimize,
        t_plan_s=search,
        t_simplify_s=shorter.seconds if shorter else None,
        n_projections=plan.counters.projections,
        n_newton_iterations=plan.counters.newton_iterations,
        n_state_checks=plan.counters.state_checks,
        n_iterations=plan.counters.iterations,
        vertices=plan.vertices,
        path_length_raw_rad=plan.path.length if plan.status is PlanStatus.SOLVED and plan.path else None,
        path_length_rad=shorter.path.length if shorter else None,
        max_violation_rad=certificate.max_violation_rad if certificate else None,
        max_violation_m=certificate.max_violation_m if certificate else None,
        min_clearance_m=_defined(certificate.min_clearance_m) if certificate else None,
        path_sha256=path_hash(shorter.path) if shorter else None,
    )


def _defined(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
