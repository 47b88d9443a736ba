"""Run planners on the same problems and seeds, and compare time, work and length."""

from statistics import median

from cvqmpt_lab import Budget, solve, suite_named

problems = [suite_named("place-task").solvable(index) for index in (2, 5, 8)]
for planner in ("birrt", "roadmap", "roadmap-cvq", "opt-cvq-mpt"):
    found = [solve(problem, planner, Budget(seconds=10.0), seed=0) for problem in problems]
    seconds = median(solution.plan.seconds for solution in found)
    projections = median(solution.plan.counters.projections for solution in found)
    lengths = [solution.path.length for solution in found if solution.solved]
    print(
        f"{planner:12} {len(lengths)} of {len(found)} solved, {1e3 * seconds:.1f} ms, "
        f"{projections:.0f} projections, {median(lengths):.2f} rad"
    )
