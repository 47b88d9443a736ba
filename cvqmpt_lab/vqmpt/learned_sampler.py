"""From predicted codes to the distribution that is sampled, and the updates that move it towards
the constraint.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.search.planner_interface import (
    GaussianMixture,
    Observation,
    Proposal,
    Query,
    widened,
)
from cvqmpt_lab.search.result import PlanStatus, Timings
from cvqmpt_lab.vqmpt.codebook import Codebook, drawn_nodes
from cvqmpt_lab.vqmpt.latent_update import LatentOptimizer
from cvqmpt_lab.vqmpt.sampler_choice import SamplerChoice

# [rad] no wide Gaussian is narrower in any direction; chosen on the tuning environments
WIDTH = 1.1
SMALLEST_STD = 1e-4  # [rad] in any direction, so that covariances stay positive definite
# of the Gaussian around each goal, as a share of each joint's range (published code)
GOAL_STD = 0.1
DRIFT = 1.5  # [rad] that a projected mean may move; others are left out


class PredictedCodes(NamedTuple):
    """What a predictor says."""

    codes: np.ndarray  # (c,) int64, those of all sequences
    goals: np.ndarray  # (k, n) that were asked about [rad or m]
    detail: str  # a few words for the result's row
    encode_seconds: float = 0.0
    predict_seconds: float = 0.0
    vertices: int = 0  # nodes of searches made on the way
    failure: PlanStatus | None = None  # why searching is pointless, or None


CodePredictor = Callable[[Query, Observation], PredictedCodes]


@dataclass(frozen=True, eq=False)
class CodeProposal(Proposal):
    """A proposal that remembers the codes it was made of."""

    codes: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (c,)
    # (k, n) that have Gaussians [rad or m]
    goals: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))


@dataclass(frozen=True, eq=False)
class LearnedSampler:
    """Gaussians of predicted codes for one robot, as a choice has them, and what moves them."""

    predict: CodePredictor
    choice: SamplerChoice
    name: str  # what result rows call the distribution
    codebook: Codebook
    robot: Robot
    noise: np.ndarray  # (codes, n) standard normal: where in its Gaussian each code's node lies

    def gaussians(
        self, codes: np.ndarray, z: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Means (c, n) [rad] and covariances (c, n, n) [rad^2] of codes (c,); z:
        where they were moved to.
        """
        means, covariances = self.codebook.gaussians(
            self.codebook.vectors[codes] if z is None else z
        )
        if self.choice.gaussians == "decoded":
            return means, widened(covariances, SMALLEST_STD)
        nodes = drawn_nodes(
            means, widened(covariances, SMALLEST_STD), self.robot, self.noise[codes]
        )
        return nodes, widened(covariances, WIDTH)

    def mixture(
        self, query: Query, goals: np.ndarray, means: np.ndarray, covariances: np.ndarray
    ) -> GaussianMixture:
        """The mixture of these Gaussians and one around each of goals (k, n)."""
        spread = np.diag((GOAL_STD * (self.robot.upper - self.robot.lower)) ** 2)
        around = np.broadcast_to(spread, (len(goals), *spread.shape))
        every = np.concatenate([means, goals]), np.concatenate([covariances, around])
        mixed = GaussianMixture.equal(*every, query.uniform, self.choice.uniform_share, self.name)
        assert isinstance(mixed, GaussianMixture)
        return mixed

    def propose(self, query: Query, observation: Observation) -> CodeProposal:
        """The sampling distribution of predicted codes: CVQ-MPT, before any update.

        Uniform samples, and a fallback that says so, where there are none.
        """
        found = self.predict(query, observation)
        some = len(found.codes) > 0
        decoded = self.gaussians(found.codes) if some else None
        return CodeProposal(
            self.mixture(query, found.goals, *decoded) if decoded else query.uniform,
            Timings(encode=found.encode_seconds, predict=found.predict_seconds),
            found.detail,
            fallback="" if some else "no code sequence reached a goal",
            vertices=found.vertices,
            failure=found.failure,
            codes=found.codes,
            goals=found.goals,
        )

    def moved(self, optimizer: LatentOptimizer, query: Query, proposal: Proposal) -> Proposal:
        """Algorithm 2 of the paper: the codes of a proposal moved by gradient towards the
        constraint, then decoded.

        The proposal itself where there is nothing to move or no constraint.
        """
        assert isinstance(proposal, CodeProposal)
        if query.space.dim == 0 or len(proposal.codes) == 0:
            return proposal
        vectors = self.codebook.vectors[proposal.codes]
        moved = optimizer.optimize(vectors, query.space.problem.manifold, query.rng)
        before, after = moved.g_before.mean(), moved.g_after.mean()
        return replace(
            proposal,
            distribution=self.mixture(
                query, proposal.goals, *self.gaussians(proposal.codes, moved.z)
            ),
            timings=replace(proposal.timings, optimize=moved.seconds),
            detail=f"{proposal.detail}, G {before:.3g} to {after:.3g}, {moved.kept.sum()} kept",
        )

    def projected(self, query: Query, proposal: Proposal) -> Proposal:
        """Every code's mean put on the manifold by Newton's method (Algorithm 1), its covariance
        left as it is.

        Codes whose mean is not near the manifold are left out; the proposal itself where there are
        none or no constraint.
        """
        assert isinstance(proposal, CodeProposal)
        if query.space.dim == 0 or len(proposal.codes) == 0:
            return proposal
        began = query.deadline.seconds
        means, covariances = self.gaussians(proposal.codes)
        near = np.zeros(len(means), dtype=bool)
        for row, mean in enumerate(means):
            q = mean.copy()
            near[row] = query.space.project(q) and np.linalg.norm(q - mean) <= DRIFT
            means[row] = q
        mixture = self.mixture(query, proposal.goals, means[near], covariances[near])
        return replace(
            proposal,
            distribution=mixture if near.any() else query.uniform,
            timings=replace(proposal.timings, optimize=query.deadline.seconds - began),
            detail=f"{proposal.detail}, {near.sum()} on the manifold",
            fallback=proposal.fallback if near.any() else "no code lies near the manifold",
        )


def union(sequences: Sequence[Sequence[int]]) -> np.ndarray:
    """Codes (c,) int64 of sequences, each once, in their order."""
    return np.array(
        list(dict.fromkeys(code for codes in sequences for code in codes)), dtype=np.int64
    )
