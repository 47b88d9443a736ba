"""Stages that use trained weights: the paper's planners, ours on the same dictionary, and their variants.

Weights, dictionaries and roadmaps are loaded once a process, before any clock starts.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from cvqmpt_lab.distributions import GaussianMixture, SamplingDistribution
from cvqmpt_lab.methods.loaded import (
    EYES,
    another_scene,
    dictionary_roadmap,
    eyes_of,
    model_of,
    observer,
    wide_observer,
)
from cvqmpt_lab.methods.method import Stages, Weights
from cvqmpt_lab.methods.mpnet_rollouts import MPNetRollouts
from cvqmpt_lab.methods.observation import Observer
from cvqmpt_lab.planning.around_path import UnconstrainedPath
from cvqmpt_lab.planning.code_proposals import CodeProposal
from cvqmpt_lab.planning.proposal import Observation, Proposal
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import JointPath, Timings
from cvqmpt_lab.planning.roadmap_proposals import RoadmapPath
from cvqmpt_lab.planning.sight import Sight
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.sensing.virtual import CameraSettings
from cvqmpt_lab.vqmpt.codebook import codes_of, dictionary_gaussians
from cvqmpt_lab.vqmpt.latent_update import LatentOptimizer, LatentSettings
from cvqmpt_lab.vqmpt.predictor import AS_PUBLISHED, Prediction, Predictor, PredictorSettings

Build = Callable[[Robot, Weights], Stages]
"""Makes the stages of a method for a robot."""
GOALS = 3  # nearest goals that the model is asked about; the search gets them all


@dataclass(frozen=True, eq=False)
class PredictedProposal(CodeProposal):
    """A proposal that remembers the prediction it was made of."""

    prediction: Prediction | None = None


@dataclass(frozen=True, eq=False)
class PredictedCodes:
    """CVQ-MPT (paper, Algorithm 1): codes predicted from cloud, start and goals become a mixture."""

    predictor: Predictor

    def __call__(self, query: Query, observation: Observation) -> PredictedProposal:
        """Predict; the timings say what the networks took."""
        assert observation.cloud is not None
        goals = query.nearest_goals(GOALS)
        prediction = self.predictor.predict(
            observation.cloud, query.start, goals, use_cache=not observation.new
        )
        lost = len(prediction.unfinished)
        detail = f"{len(prediction.codes)} codes" + (
            f", none to {lost} of {len(goals)} goals" if lost else ""
        )
        return PredictedProposal(
            self.predictor.mixture(prediction),
            Timings(prediction.encode_seconds, prediction.predict_seconds),
            detail,
            fallback="" if len(prediction.codes) else "no code sequence reached a goal",
            codes=prediction.codes,
            prediction=prediction,
        )


@dataclass(frozen=True, eq=False)
class MovedCodes:
    """The update of Opt-CVQ-MPT (paper, Algorithm 2): predicted codes moved towards the constraint."""

    predictor: Predictor
    optimizer: LatentOptimizer

    def __call__(self, query: Query, proposal: Proposal) -> Proposal:
        """The mixture of the moved codes; the proposal itself where there is nothing to move or no constraint."""
        assert isinstance(proposal, PredictedProposal) and proposal.prediction is not None
        prediction = proposal.prediction
        if query.space.dim == 0 or len(prediction.codes) == 0:
            return proposal
        moved = self.optimizer.optimize(prediction.z, query.space.problem.manifold, query.rng)
        before, after = moved.g_before.mean(), moved.g_after.mean()
        return replace(
            proposal,
            distribution=self.predictor.mixture(prediction, moved.z),
            timings=replace(proposal.timings, optimize=moved.seconds),
            detail=f"{proposal.detail}, G {before:.3g} to {after:.3g}, {moved.kept.sum()} kept",
        )


@lru_cache(maxsize=16)
def _predictor(weights: Weights, robot: Robot, settings: PredictorSettings) -> Predictor:
    return Predictor(model_of(weights), robot, settings)


def published(name: str, update: int | None) -> Build:
    """CVQ-MPT by a model of the authors' architecture; Opt-CVQ-MPT after `update` latent steps."""
    return _cvq_mpt(PredictorSettings(name=name), None if update is None else LatentSettings(steps=update))


def as_published(name: str) -> Build:
    """CVQ-MPT as its authors' code has it."""
    return _cvq_mpt(replace(AS_PUBLISHED, name=name))


def _cvq_mpt(settings: PredictorSettings, update: LatentSettings | None = None) -> Build:
    def build(robot: Robot, weights: Weights) -> Stages:
        predictor = _predictor(weights, robot, settings)
        moved = None if update is None else MovedCodes(predictor, LatentOptimizer(predictor.codebook, update))
        return Stages(predict=PredictedCodes(predictor), observe=observer(), update=moved)

    return build


def roadmap_path(wrong: bool = False, blind: bool = False, told: bool = False) -> Build:
    """The dictionary, projected on the manifold node by node, searched for a path along edges that look free.

    wrong: shown another scene. blind: shown none, as are models without eyes. told: blind, but knows what is blocked.
    """

    def build(robot: Robot, weights: Weights) -> Stages:
        roadmap = dictionary_roadmap(weights, robot)
        if blind or told or EYES not in model_of(weights).parts:
            return Stages(predict=RoadmapPath(roadmap, told=told))
        return Stages(
            predict=RoadmapPath(roadmap, see=partial(_sight, weights)),
            observe=another_scene if wrong else wide_observer(),
        )

    return build


def _sight(weights: Weights, query: Query, observation: Observation) -> Sight:
    """What the robot, and what it carries, sees in the cloud."""
    assert observation.cloud is not None
    return eyes_of(weights, query.space.robot, query.space.problem.attachments).look(
        observation.cloud, observation.new
    )


def true_codes(name: str) -> Build:
    """The codes of an unconstrained path of the very problem: a model that never errs."""

    def build(robot: Robot, weights: Weights) -> Stages:
        means, covariances = dictionary_gaussians(model_of(weights), robot)
        share = PredictorSettings().uniform_share

        def suggest(query: Query, path: JointPath) -> SamplingDistribution:
            codes = np.unique(codes_of(model_of(weights), robot, path.spaced(0.2)))
            return GaussianMixture.equal(means[codes], covariances[codes], query.uniform, share, name)

        return Stages(predict=UnconstrainedPath(suggest))

    return build


def mpnet(robot: Robot, weights: Weights) -> Stages:
    """MPNet's rollouts."""
    seen = CameraSettings.like_training(model_of(weights).config.n_points)
    return Stages(predict=_rollouts(weights), observe=_mpnet_observer(seen))


@lru_cache(maxsize=4)
def _rollouts(weights: Weights) -> MPNetRollouts:
    return MPNetRollouts(model_of(weights))


@lru_cache(maxsize=4)
def _mpnet_observer(settings: CameraSettings) -> Observer:
    return Observer(settings)
