"""Rows that a reviewer asks for: what a sampler without a network, or with the true codes, would do."""

from dataclasses import dataclass, field, replace

import numpy as np

from cvqmpt_lab.distributions import GaussianMixture, SamplingDistribution, Uniform
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.result import Budget, Path, PlanResult
from cvqmpt_lab.planning.simplify import simplify
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.prediction.dictionary_gaussians import codes_of, dictionary_gaussians
from cvqmpt_lab.prediction.predictor import Predictor


@dataclass(frozen=True)
class StraightLine:
    """birrt with Gaussians along the straight line to the nearest goals.

    Attributes
    ----------
    std: of each Gaussian, in every joint [rad]. spacing: between Gaussians [rad]. goals: nearest ones, so many.
    """

    name: str = "straight-line"
    uniform_share: float = 0.15
    std: float = 0.5
    spacing: float = 0.5
    goals: int = 3
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
        """Search a path from start (n,) to any row of goals (k, n)."""
        allowance = Allowance(budget, space)
        near = np.argsort(np.linalg.norm(goals - start, axis=1), kind="stable")[: self.goals]
        means = np.concatenate([Path(np.stack([start, goal])).spaced(self.spacing) for goal in goals[near]])
        covariances = np.tile(self.std**2 * np.eye(len(start)), (len(means), 1, 1))
        uniform = Uniform(space.robot.lower, space.robot.upper)
        weights = np.full(len(means), 1.0 / len(means))
        mixture = GaussianMixture(means, covariances, weights, uniform, self.uniform_share, self.name)
        result = self.core.plan(space, start, goals, mixture, allowance.rest(), rng)
        return replace(result, seconds=allowance.seconds)


@dataclass(frozen=True, eq=False)
class TrueCodes:
    """birrt with the codes of an unconstrained path of this very problem: a model that never errs.

    The path is planned, and paid for, as `guided-birrt` does; only its waypoints become codes.
    """

    predictor: Predictor
    name: str = "true-codes"
    spacing: float = 0.2
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
        path = simplify(free_space, guide.path, rng).path
        mixture = self._mixture(path, space)
        result = self.core.plan(space, start, goals, mixture, allowance.rest(), rng)
        return replace(
            result,
            seconds=allowance.seconds,
            counters=space.counters_since(before),
            vertices=guide.vertices + result.vertices,
        )

    def _mixture(self, path: Path, space: ConstrainedSpace) -> GaussianMixture:
        """Gaussians of the distinct codes of a path, with the predictor's uniform share."""
        checkpoint = self.predictor.checkpoint
        means, covariances = dictionary_gaussians(checkpoint, space.robot)
        codes = np.unique(codes_of(checkpoint, space.robot, path.spaced(self.spacing)))
        uniform = Uniform(space.robot.lower, space.robot.upper)
        weights = np.full(len(codes), 1.0 / len(codes))
        share = self.predictor.settings.uniform_share
        return GaussianMixture(means[codes], covariances[codes], weights, uniform, share, self.name)
