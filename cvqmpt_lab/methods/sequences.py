"""Stages that predict sequences of codes: the paper's planners and controls."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from cvqmpt_lab.distributions import GaussianMixture
from cvqmpt_lab.methods.learned import published
from cvqmpt_lab.methods.loaded import (
    codebook_of,
    dictionary_roadmap,
    drawn_noise,
    model_of,
    seen_dictionary,
    wide_observer,
)
from cvqmpt_lab.methods.method import CloudOf, Stages, Weights
from cvqmpt_lab.planning.code_graph import SeenGraph
from cvqmpt_lab.planning.code_proposals import CodeProposal, PredictedSequences
from cvqmpt_lab.planning.proposal import Proposal
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.vqmpt.codebook import Codebook, drawn_nodes, widened
from cvqmpt_lab.vqmpt.latent_update import LatentOptimizer, LatentSettings

WIDTH = 1.1  # [rad] no Gaussian that is sampled from is narrower in any direction; chosen on the tuning environments
STEPS = 5  # of Algorithm 2


@dataclass(frozen=True, eq=False)
class MovedGaussians:
    """The update of Opt-CVQ-MPT (paper, Algorithm 2): the codes of a proposal moved towards the constraint."""

    codebook: Codebook
    optimizer: LatentOptimizer

    def __call__(self, query: Query, proposal: Proposal) -> Proposal:
        """Sample around the moved codes; the proposal itself where there is nothing to move or to sample for."""
        assert isinstance(proposal, CodeProposal)
        mixture = proposal.distribution
        if query.space.dim == 0 or not isinstance(mixture, GaussianMixture):
            return proposal
        z, manifold = self.codebook.vectors[proposal.codes], query.space.problem.manifold
        moved = self.optimizer.optimize(z, manifold, query.rng)
        means, covariances = self.codebook.gaussians(moved.z)
        noise = drawn_noise(len(self.codebook.vectors), query.space.robot.dof)[proposal.codes]
        means = drawn_nodes(means, covariances, query.space.robot, noise)
        return replace(
            proposal,
            distribution=replace(mixture, means=means, covariances=widened(covariances, WIDTH)),
            timings=replace(proposal.timings, optimize=moved.seconds),
            detail=f"{proposal.detail}, G {moved.g_before.mean():.3g} to {moved.g_after.mean():.3g}, "
            f"{moved.kept.sum()} kept",
        )


def sequences(
    name: str,
    *,
    early: bool = False,
    update: int | None = None,
    cloud: CloudOf | None = None,
    uniform_share: float = 0.15,
) -> Callable[[Robot, Weights], Stages]:
    """CVQ-MPT: the cheapest sequences of codes as a mixture.

    early: codes are projected before sequences are judged, and sampled around there. update: steps of Algorithm 2
    instead. cloud: shown in place of the scene's. Models of kind "published" have a sequence model of their own,
    which cannot go early: Algorithm 2 moves its codes.
    """

    def build(robot: Robot, weights: Weights) -> Stages:
        if model_of(weights).config.kind == "published":
            return published(name, STEPS if early else update)(robot, weights)
        seen_dictionary(weights, robot)  # a model without eyes is refused before the clock starts
        covariances = widened(dictionary_roadmap(weights, robot).covariances, WIDTH)
        moved = None
        if update is not None:
            codebook = codebook_of(weights, robot)
            moved = MovedGaussians(codebook, LatentOptimizer(codebook, LatentSettings(steps=update)))
        seen = partial(_seen, weights)
        return Stages(
            predict=PredictedSequences(name, seen, covariances, uniform_share=uniform_share, early=early),
            observe=cloud or wide_observer(),
            update=moved,
        )

    return build


def _seen(weights: Weights, query: Query) -> SeenGraph:
    """The dictionary before the eyes of the query's robot and what it carries."""
    return seen_dictionary(weights, query.space.robot, query.space.problem.attachments)
