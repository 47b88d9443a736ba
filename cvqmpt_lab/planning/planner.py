"""The one interface behind which all planners stand."""

from typing import Protocol

import numpy as np

from cvqmpt_lab.distributions import SamplingDistribution
from cvqmpt_lab.planning.result import Budget, PlanResult
from cvqmpt_lab.planning.space import ConstrainedSpace


class Planner(Protocol):
    """A constrained motion planner."""

    @property
    def name(self) -> str:
        """Its key in the table of planners."""

    def plan(
        self,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        sampler: SamplingDistribution,
        budget: Budget,
        rng: np.random.Generator,
    ) -> PlanResult:
        """Search a path from start (n,) to any row of goals (k, n) [rad or m]."""
