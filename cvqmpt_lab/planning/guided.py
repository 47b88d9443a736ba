"""The honest rival of every learned sampler: plan without the constraint first, then sample around that path."""

from dataclasses import dataclass, field, replace

import numpy as np

from cvqmpt_lab.distributions import GaussianMixture, SamplingDistribution, Uniform
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.result import Budget, Path, PlanResult
from cvqmpt_lab.planning.simplify import simplify
from cvqmpt_lab.planning.space import ConstrainedSpace


@dataclass(frozen=True)
class GuidedBiRRT:
    """birrt with Gaussians around the waypoints of an unconstrained path, which it plans and pays for itself.

    Attributes
    ----------
    std: of each Gaussian, in every joint [rad]. uniform_share: samples drawn anywhere instead.
    spacing: between waypoints along the path [rad].
    """

    name: str = "guided-birrt"
    std: float = 0.5
    uniform_share: float = 0.15
    spacing: float = 0.5
    core: BiRRT = field(default_factory=BiRRT)

    def plan(
        self,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        sampler: SamplingDistribution,
        budget: Budget,
        rng: np.random.Generator,
    ) -> PlanResult:
        """Search a path from start (n,) to any row of goals (k, n); `sampler` serves the unconstrained part."""
        allowance, before = Allowance(budget, space), space.counters
        free_space = space.unconstrained()
        guide = self.core.plan(free_space, start, goals, sampler, budget, rng)
        if guide.path is None:
            return replace(guide, detail="no unconstrained path")
        uniform = Uniform(space.robot.lower, space.robot.upper)
        mixture = self._around(simplify(free_space, guide.path, rng).path, uniform)
        result = self.core.plan(space, start, goals, mixture, allowance.rest(), rng)
        return replace(
            result,
            seconds=allowance.seconds,
            counters=space.counters_since(before),
            vertices=guide.vertices + result.vertices,
        )

    def _around(self, path: Path, uniform: Uniform) -> GaussianMixture:
        """Equal Gaussians at waypoints `spacing` apart along a path, and a uniform share."""
        means = path.spaced(self.spacing)
        k, n = means.shape
        covariances = np.tile(self.std**2 * np.eye(n), (k, 1, 1))
        return GaussianMixture(means, covariances, np.full(k, 1.0 / k), uniform, self.uniform_share, "guide")
