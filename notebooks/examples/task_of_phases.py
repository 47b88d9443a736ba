"""Plan a task of several phases: open the door, take the can, set it down."""

from cvqmpt_lab import Budget, solve_task, suite_named

task = suite_named("multi-sequence").item(3)
solution = solve_task(task, "birrt", Budget(seconds=10.0), seed=0)
for outcome in solution.outcomes:
    print(outcome.phase.name, "solved" if outcome.solved else outcome.reason)
