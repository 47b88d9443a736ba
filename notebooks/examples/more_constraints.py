"""Keep a distance from the shoulder, stay on a sphere, stay on a cylinder."""

from cvqmpt_lab import Budget, solve, suite_named

suite = suite_named("constraints-more")
solutions = [solve(suite.solvable(k), "birrt", Budget(5.0), seed=0) for k in (20, 40, 60)]
for solution in solutions:
    print(solution.problem.manifold.describe(), solution, sep="\n")
