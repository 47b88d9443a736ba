"""Draw a solution as a still picture."""

from cvqmpt_lab import Budget, draw, solve, suite_named

problem = suite_named("place-task").solvable(7)
solution = solve(problem, "roadmap", Budget(2.0), seed=0, optimize=Budget(0.25))
draw(solution, "plan.png")
print("plan.png")
