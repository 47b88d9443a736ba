"""Keep a distance, stay on a sphere or a cylinder, couple two joints, keep the centre of mass."""

from cvqmpt_lab import Budget, solve, suite_named

suite = suite_named("constraints-more")
solutions = [solve(suite.solvable(k), "birrt", Budget(5.0), seed=0) for k in (20, 40, 60, 82, 100)]
for solution in solutions:
    print(solution.problem.manifold.describe(), solution, sep="\n")
