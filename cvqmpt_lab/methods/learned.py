"""Stages that use trained weights: the paper's planners, ours on the same dictionary, and their variants.

Weights, dictionaries and roadmaps are loaded once a process, before any clock starts.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from cvqmpt_lab.distributions import GaussianMixture, SamplingDistribution
from cvqmpt_lab.methods.method import CloudOf, Stages, Weights
from cvqmpt_lab.methods.mpnet_rollouts import MPNetRollouts
from cvqmpt_lab.methods.observation import Observer
from cvqmpt_lab.models.stored import StoredModel, read_model
from cvqmpt_lab.planning.around_path import UnconstrainedPath
from cvqmpt_lab.planning.proposal import Observation, Proposal
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import JointPath, Timings
from cvqmpt_lab.planning.roadmap import Roadmap
from cvqmpt_lab.planning.roadmap_proposals import Gaussians, RoadmapMixture, RoadmapPath
from cvqmpt_lab.planning.sight import Eyes, Sight, SightNetwork
from cvqmpt_lab.prediction.collision_head import CollisionHead
from cvqmpt_lab.prediction.dictionary_gaussians import codes_of, dictionary_gaussians, drawn_nodes
from cvqmpt_lab.prediction.latent_optimizer import LatentOptimizer, LatentSettings
from cvqmpt_lab.prediction.prediction import Prediction
from cvqmpt_lab.prediction.predictor import Predictor
from cvqmpt_lab.prediction.settings import AS_PUBLISHED, PredictorSettings
from cvqmpt_lab.prediction.weights import SHIPPED, resolve_model
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.attachment import Attachment
from cvqmpt_lab.scene.cameras import CameraSettings
from cvqmpt_lab.scene.families import family_scene

Build = Callable[[Robot, Weights], Stages]
"""Makes the stages of a method for a robot."""
ROADMAP_DRAW = 4  # seed of the draw from the dictionary, the best of six on the tuning environments
BELIEVED = 0.5  # P(free) below which a node is left out
GOALS = 3  # nearest goals that the model is asked about; the search gets them all
POINTS_SEEN = 4096  # of a cloud that distances are measured to
WRONG_SCENE = ("shelves", 77)  # shown to the model in place of the problem's own scene


@dataclass(frozen=True, eq=False)
class PredictedProposal(Proposal):
    """A proposal that remembers the codes it was made of."""

    prediction: Prediction | None = None


@dataclass(frozen=True, eq=False)
class PredictedCodes:
    """CVQ-MPT (paper, Algorithm 1): codes predicted from cloud, start and goals become a mixture."""

    predictor: Predictor

    def __call__(self, query: Query, observation: Observation) -> PredictedProposal:
        """Predict; the timings say what the networks took."""
        assert observation.cloud is not None
        goals = query.nearest_goals(GOALS)
        prediction = self.predictor.predict(observation.cloud, query.start, goals, query.rng)
        lost = len(prediction.unfinished)
        detail = f"{len(prediction.codes)} codes" + (
            f", none to {lost} of {len(goals)} goals" if lost else ""
        )
        return PredictedProposal(
            self.predictor.mixture(prediction),
            Timings(prediction.encode_seconds, prediction.predict_seconds),
            detail,
            fallback="" if len(prediction.codes) else "no code sequence reached a goal",
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
        moved = self.optimizer.optimize(prediction, query.space.problem.manifold, query.rng)
        before, after = moved.g_before.mean(), moved.g_after.mean()
        return replace(
            proposal,
            distribution=self.predictor.mixture(prediction, moved.z),
            timings=replace(proposal.timings, optimize=moved.seconds),
            detail=f"{proposal.detail}, G {before:.3g} to {after:.3g}, {moved.kept.sum()} kept",
        )


# ------------------------------------------------------------------ loaded once


@lru_cache(maxsize=4)
def _model(weights: Weights) -> StoredModel:
    of = SHIPPED[weights.kind]
    return read_model(resolve_model(weights.model or weights.kind, of), architecture=of)


@lru_cache(maxsize=1)
def _observer() -> Observer:
    return Observer()


@lru_cache(maxsize=1)
def _wide_observer() -> Observer:
    return Observer(CameraSettings.like_training(POINTS_SEEN))


@lru_cache(maxsize=8)
def _eyes(weights: Weights, robot: Robot, attachments: tuple[Attachment, ...]) -> Eyes:
    return Eyes(SightNetwork.of(_model(weights).parts["sight"]), robot, attachments)


@lru_cache(maxsize=16)
def _predictor(weights: Weights, robot: Robot, settings: PredictorSettings) -> Predictor:
    return Predictor(_model(weights), robot, settings)


@lru_cache(maxsize=4)
def _collision_head(weights: Weights, robot: Robot) -> CollisionHead:
    return CollisionHead(_model(weights), robot)


@lru_cache(maxsize=8)
def dictionary_roadmap(weights: Weights, robot: Robot) -> Roadmap:
    """The dictionary: one configuration drawn from each code's Gaussian."""
    means, covariances = dictionary_gaussians(_model(weights), robot)
    nodes = drawn_nodes(means, covariances, robot, np.random.default_rng(ROADMAP_DRAW))
    return Roadmap.of(nodes, covariances)


# ------------------------------------------------------------------ stages by name


def predicted(name: str, update: int | None = None, wrong: bool = False, **settings: Any) -> Build:
    """CVQ-MPT with predictor settings; Opt-CVQ-MPT after `update` latent steps. wrong: shown another scene."""
    return _cvq_mpt(
        PredictorSettings(name=name, **settings),
        None if update is None else LatentSettings(steps=update),
        partial(_wrong_cloud, _observer()) if wrong else None,
    )


def as_published(name: str) -> Build:
    """CVQ-MPT as its authors' code has it."""
    return _cvq_mpt(replace(AS_PUBLISHED, name=name))


def _cvq_mpt(
    settings: PredictorSettings, update: LatentSettings | None = None, observe: CloudOf | None = None
) -> Build:
    def build(robot: Robot, weights: Weights) -> Stages:
        predictor = _predictor(weights, robot, settings)
        moved = None if update is None else MovedCodes(predictor, LatentOptimizer(predictor, update))
        return Stages(predict=PredictedCodes(predictor), observe=observe or _observer(), update=moved)

    return build


def _wrong_cloud(observer: Observer, problem: PlanningProblem) -> np.ndarray:
    """The cloud of another scene."""
    return observer(replace(problem, scene=family_scene(*WRONG_SCENE)))


def roadmap_path(wrong: bool = False) -> Build:
    """The dictionary, projected on the manifold node by node, searched for a path along edges that look free.

    wrong: shown another scene. Models without eyes go blindly.
    """

    def build(robot: Robot, weights: Weights) -> Stages:
        roadmap = dictionary_roadmap(weights, robot)
        if "sight" not in _model(weights).parts:
            return Stages(predict=RoadmapPath(roadmap))
        return Stages(
            predict=RoadmapPath(roadmap, see=partial(_sight, weights)),
            observe=partial(_wrong_cloud, _wide_observer()) if wrong else _wide_observer(),
        )

    return build


def _sight(weights: Weights, query: Query, observation: Observation) -> Sight:
    """What the robot, and what it carries, sees in the cloud."""
    assert observation.cloud is not None
    return _eyes(weights, query.space.robot, query.space.problem.attachments).look(observation.cloud)


def roadmap_mixture(name: str, check: bool, head: bool = False, update: bool = False) -> Build:
    """Unconstrained roadmap paths as a sampling distribution; without checks, the blind twin.

    head: nodes that the model believes blocked are left out. update: the codes are moved to the manifold.
    """

    def build(robot: Robot, weights: Weights) -> Stages:
        roadmap = dictionary_roadmap(weights, robot)
        return Stages(
            predict=RoadmapMixture(
                roadmap,
                name,
                check,
                blocked=believed_blocked(weights, roadmap) if head else None,
                move=moved_to_manifold(weights) if update else None,
            ),
            observe=_observer() if head else None,
        )

    return build


def believed_blocked(weights: Weights, roadmap: Roadmap) -> Callable[[Query, Observation], np.ndarray]:
    """Tells which nodes (N,) bool the collision head calls blocked, from the cloud."""

    def blocked(query: Query, observation: Observation) -> np.ndarray:
        assert observation.cloud is not None
        head = _collision_head(weights, query.space.robot)
        return head.free_probability(observation.cloud, roadmap.nodes) < BELIEVED

    return blocked


def moved_to_manifold(weights: Weights) -> Callable[[Query, np.ndarray], Gaussians]:
    """Gives Gaussians of codes (r,) after the latent update towards the query's constraint."""

    def move(query: Query, codes: np.ndarray) -> Gaussians:
        predictor = _predictor(weights, query.space.robot, PredictorSettings())
        z, manifold = predictor.vectors[codes], query.space.problem.manifold
        moved = LatentOptimizer(predictor).optimize_codes(z, None, manifold, query.rng)
        gaussians, model = predictor.decoder.decode(moved.z, None), predictor.configurations
        means = model.radians(gaussians.mean.astype(float))
        return Gaussians(means, gaussians.covariance * np.outer(model.range, model.range))

    return move


def true_codes(name: str) -> Build:
    """The codes of an unconstrained path of the very problem: a model that never errs."""

    def build(robot: Robot, weights: Weights) -> Stages:
        means, covariances = dictionary_gaussians(_model(weights), robot)
        share = PredictorSettings().uniform_share

        def suggest(query: Query, path: JointPath) -> SamplingDistribution:
            codes = np.unique(codes_of(_model(weights), robot, path.spaced(0.2)))
            return GaussianMixture.equal(means[codes], covariances[codes], query.uniform, share, name)

        return Stages(predict=UnconstrainedPath(suggest))

    return build


def mpnet(robot: Robot, weights: Weights) -> Stages:
    """MPNet's rollouts."""
    seen = CameraSettings.like_training(_model(weights).config.n_points)
    return Stages(predict=_rollouts(weights), observe=_mpnet_observer(seen))


@lru_cache(maxsize=4)
def _rollouts(weights: Weights) -> MPNetRollouts:
    return MPNetRollouts(_model(weights))


@lru_cache(maxsize=4)
def _mpnet_observer(settings: CameraSettings) -> Observer:
    return Observer(settings)
