"""Give the search a sampling distribution of your own: Gaussians halfway to the goals."""

import numpy as np

from cvqmpt_lab import Budget, GaussianMixture, Method, solve
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.search.planner_interface import Proposal


def halfway(query, observation):
    """Mix equal Gaussians halfway to each goal with one uniform sample in five."""
    means = 0.5 * (query.start + query.goals)
    covariance = 0.3**2 * np.eye(len(query.start))
    return Proposal(GaussianMixture.equal(means, covariance, query.uniform, 0.2, "halfway"))


problem = suite_named("place-task").solvable(7)
method = Method.simple("halfway", predict=halfway)
solution = solve(problem, method, Budget(seconds=10.0), seed=0)
print(solution)
