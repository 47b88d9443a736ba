"""One planning question, and what is left of the budget for answering it."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.distributions import Uniform
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.space import ConstrainedSpace


@dataclass(frozen=True, eq=False)
class Query:
    """From where to where, in which space, with how much and by which luck."""

    space: ConstrainedSpace
    start: np.ndarray
    """(n,) [rad or m]."""
    goals: np.ndarray
    """(k, n) [rad or m]; any one will do."""
    allowance: Allowance
    """What predictions and searches share; its clock runs since the query was made."""
    rng: np.random.Generator

    @classmethod
    def of(cls, space: ConstrainedSpace, budget: Budget, rng: np.random.Generator) -> "Query":
        """The question that a space's problem asks; the clock starts now."""
        return cls(space, space.problem.start, space.problem.goals, Allowance(budget, space), rng)

    @property
    def uniform(self) -> Uniform:
        """Between the robot's limits."""
        return Uniform(self.space.robot.lower, self.space.robot.upper)

    def nearest_goals(self, count: int) -> np.ndarray:
        """The goals (at most count, n) nearest to the start, nearest first."""
        distances = np.linalg.norm(self.goals - self.start, axis=1)
        return self.goals[np.argsort(distances, kind="stable")[:count]]
