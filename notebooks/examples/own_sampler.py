"""Give the search your own sampling distribution: Gaussians halfway to the goals."""

from cvqmpt_lab import Budget, GaussianMixture, Method, Proposal, solve, suite_named

import numpy as np


def halfway(query, observation):
    """Return equal Gaussians halfway to each goal, mixed with 20 % uniform samples."""
    means = 0.5 * (query.start + query.goals)
    covariance = 0.3**2 * np.eye(len(query.start))
    return Proposal(GaussianMixture.equal(means, covariance, query.uniform, 0.2, "halfway"))


problem = suite_named("place-task").solvable(7)
method = Method.simple("halfway", predict=halfway)
solution = solve(problem, method, Budget(seconds=10.0), seed=0)
print(solution)
