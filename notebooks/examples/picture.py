"""Draw a solution as a still picture."""

from cvqmpt_lab import Budget, draw, solve
from cvqmpt_lab.benchmarks.suite import suite_named

problem = suite_named("place-task").solvable(7)
draw(solve(problem, "roadmap", Budget(seconds=10.0), seed=0), "plan.png")
print("plan.png")
