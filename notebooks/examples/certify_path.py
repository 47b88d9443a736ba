"""Certify a path of your own; the certificate lists every violated bound."""

from cvqmpt_lab import Budget, JointPath, certify, solve, suite_named

import numpy as np

problem = suite_named("place-task").solvable(7)
solution = solve(problem, "roadmap", Budget(seconds=10.0), seed=0)
path = solution.path
straight = JointPath(np.linspace(path.states[0], path.states[-1], 200))
for name, judged in (("planned", path), ("straight", straight)):
    certificate = certify(solution.problem, judged)
    print(name, certificate.verdict, *certificate.reasons, sep="; ")
