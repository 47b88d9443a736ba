"""What is left of a budget while several searches and a network share it."""

import math
import time

from cvqmpt_lab.kernels.search.space_arrays import ITERATIONS
from cvqmpt_lab.planning.result import Budget, Counters, JointPath, PlanResult, PlanStatus
from cvqmpt_lab.planning.space import ConstrainedSpace

LEAST_SECONDS = 1e-3


class Allowance:
    """A budget in use since this object was made; iterations are read from the space's counters."""

    def __init__(self, budget: Budget, space: ConstrainedSpace) -> None:
        self.budget, self._space = budget, space
        self._began = time.perf_counter()
        self._counters = space.counters

    @property
    def seconds(self) -> float:
        """Used so far [s]."""
        return time.perf_counter() - self._began

    @property
    def iterations(self) -> int:
        """Used so far."""
        return self._space.counters.iterations - self._counters.iterations

    def count(self, iterations: int = 1) -> None:
        """Use iterations that no search counts."""
        self._space.arrays.counters[ITERATIONS] += iterations

    def spent(self) -> PlanStatus | None:
        """How the run ends if nothing is left; None while something is."""
        if self.budget.seconds is not None and self.seconds >= self.budget.seconds:
            return PlanStatus.TIMEOUT
        if self.budget.iterations is not None and self.iterations >= self.budget.iterations:
            return PlanStatus.ITERATION_LIMIT
        return None

    def part(self, share: float) -> Budget:
        """A share of the whole budget, or what is left if that is less; ask `spent` first."""
        seconds, iterations = self.budget.seconds, self.budget.iterations
        if seconds is not None:
            seconds = max(min(share * seconds, seconds - self.seconds), LEAST_SECONDS)
        if iterations is not None:
            iterations = max(min(math.ceil(share * iterations), iterations - self.iterations), 1)
        return Budget(seconds, iterations)

    def rest(self) -> Budget:
        """What is left of the budget; ask `spent` first."""
        return self.part(1.0)

    @property
    def counters(self) -> Counters:
        """Work done so far."""
        return self._space.counters_since(self._counters)

    def ended(self, status: PlanStatus, sampler: str, path: JointPath | None = None) -> PlanResult:
        """The result of a run that stops here, without a tree."""
        return PlanResult(status, path, self.seconds, self.counters, 0, sampler)
