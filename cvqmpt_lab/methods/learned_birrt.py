"""The paper's planners: birrt on the mixture that VQ-MPT predicts, its codes moved to the manifold or not."""

from dataclasses import dataclass, field, replace

import numpy as np

from cvqmpt_lab.constraints.task_space_region import RegionConstraint
from cvqmpt_lab.distributions import SamplingDistribution
from cvqmpt_lab.methods.observation import CloudOf
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.birrt import BiRRT
from cvqmpt_lab.planning.result import Budget, PlanResult, Timings
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.prediction.latent_optimizer import LatentOptimizer
from cvqmpt_lab.prediction.predictor import Predictor


@dataclass(frozen=True, eq=False)
class LearnedBiRRT:
    """CVQ-MPT (paper, Algorithm 1), and Opt-CVQ-MPT (Algorithm 2) when there is an optimizer.

    Attributes
    ----------
    cloud_of: gives the point cloud of a problem, before the clock starts.
    goals: the model is asked about the goals nearest to the start, so many; the planner gets them all.
    """

    predictor: Predictor
    cloud_of: CloudOf
    optimizer: LatentOptimizer | None = None
    goals: int = 3
    name: str = "cvq-mpt"
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
        """Search a path from start (n,) to any row of goals (k, n); the model takes the sampler's place."""
        cloud = self.cloud_of(space.problem)
        allowance = Allowance(budget, space)
        near = np.argsort(np.linalg.norm(goals - start, axis=1), kind="stable")[: self.goals]
        prediction = self.predictor.predict(cloud, start, goals[near], rng)
        z, optimized, detail = None, None, f"{len(prediction.codes)} codes"
        if self.optimizer is not None and space.dim > 0 and len(prediction.codes):
            constraint = RegionConstraint(space.robot, tuple(space.problem.constraint))
            result = self.optimizer.optimize(prediction, constraint, rng)
            z, optimized = result.z, result.seconds
            detail += (
                f", G {result.g_before.mean():.3g} to {result.g_after.mean():.3g}, {result.kept.sum()} kept"
            )
        mixture = self.predictor.mixture(prediction, z)
        timings = Timings(prediction.encode_seconds, prediction.predict_seconds, optimized)
        if (status := allowance.spent()) is not None:
            return replace(allowance.ended(status, mixture.name, detail), timings=timings)
        plan = self.core.plan(space, start, goals, mixture, allowance.rest(), rng)
        return replace(plan, seconds=allowance.seconds, timings=timings, detail=detail)
