"""Stages of planners with trained weights: what they observe, predict and update with.

Weights, dictionaries and roadmaps are loaded once a process, before any clock starts. A model is a name or folder as
`weights.resolve_model` takes it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.search.guides import UnconstrainedPath
from cvqmpt_lab.search.query import (
    GaussianMixture,
    Observation,
    Proposal,
    Query,
    SamplingDistribution,
    Stages,
    widened,
)
from cvqmpt_lab.search.result import JointPath, Timings
from cvqmpt_lab.search.roadmap import Roadmap, RoadmapPath
from cvqmpt_lab.sensing.observation import Observer
from cvqmpt_lab.sensing.virtual import CameraSettings
from cvqmpt_lab.vqmpt.codebook import Codebook, code_noise, codes_of, dictionary_gaussians, drawn_nodes
from cvqmpt_lab.vqmpt.edge_model import EdgeArrays, EdgeModel, SmallNetwork
from cvqmpt_lab.vqmpt.latent_update import LatentOptimizer, LatentSettings
from cvqmpt_lab.vqmpt.mpnet_rollouts import BRIDGED, MPNetRollouts, MPNetSettings
from cvqmpt_lab.vqmpt.predictor import AS_PUBLISHED, Prediction, Predictor, PredictorSettings
from cvqmpt_lab.vqmpt.sampler import CodeProposal, CodeRoadmap, PredictedSequences
from cvqmpt_lab.vqmpt.weights import MPNET, VQ_MPT, StoredModel, read_model, resolve_model

EDGE_PART = "sight"  # the edge validity model among the parts of a model
POINTS = 4096  # of a cloud that becomes a distance field
OTHER_SCENE = ("shelves", 77)  # shown by controls in place of the problem's own scene
WIDTH = 1.1  # [rad] no Gaussian that is sampled from is narrower in any direction; chosen on the tuning environments
STEPS = 5  # of Algorithm 2
GOALS = 3  # nearest goals that a published model is asked about; the search gets them all


@lru_cache(maxsize=4)
def model_of(model: str, architecture: str = VQ_MPT) -> StoredModel:
    """The weights of that name or folder."""
    return read_model(resolve_model(model, architecture), architecture=architecture)


@lru_cache(maxsize=8)
def edge_model(model: str, robot: Robot, attachments: tuple[Attachment, ...] = ()) -> EdgeModel:
    """A model's edge validity model, for a robot and what it carries; InvalidInputError where it has none."""
    parts = model_of(model).parts
    if EDGE_PART not in parts:
        raise InvalidInputError(
            f"{model} has no edge validity model, only {', '.join(parts)}; train one: cvqmpt train edge-model"
        )
    return EdgeModel(SmallNetwork.of(parts[EDGE_PART]), robot, attachments)


@lru_cache(maxsize=8)
def codebook_of(model: str, robot: Robot) -> Codebook:
    """The dictionary's codes as Gaussians."""
    return Codebook(model_of(model), robot)


@lru_cache(maxsize=8)
def dictionary_roadmap(model: str, robot: Robot) -> Roadmap:
    """The dictionary: one configuration drawn from each code's Gaussian."""
    means, covariances = dictionary_gaussians(model_of(model), robot)
    return Roadmap.of(drawn_nodes(means, covariances, robot, code_noise(len(means), robot.dof)), covariances)


@lru_cache(maxsize=8)
def code_roadmap(model: str, robot: Robot, attachments: tuple[Attachment, ...] = ()) -> CodeRoadmap:
    """The dictionary's roadmap with edge costs."""
    bare = code_roadmap(model, robot) if attachments else None
    return CodeRoadmap(dictionary_roadmap(model, robot), edge_model(model, robot, attachments), bare)


@lru_cache(maxsize=4)
def observer(points: int | None = None) -> Observer:
    """Renders clouds of that many points, or as many as point encoders were trained on."""
    return Observer(CameraSettings.like_training(points) if points else None)


def other_scene(scene: Scene) -> np.ndarray:
    """The cloud of another scene, whatever the scene."""
    return observer(POINTS)(family_scene(*OTHER_SCENE))


def no_cloud(scene: Scene) -> np.ndarray:
    """No points (0, 3)."""
    return np.empty((0, 3))


CLOUDS: dict[str | None, Callable[[Scene], np.ndarray]] = {"other scene": other_scene, "none": no_cloud}
"""What controls see in place of the scene."""


def sequences(
    robot: Robot,
    model: str,
    name: str,
    *,
    project_first: bool = False,
    update: int | None = None,
    cloud: str | None = None,
    uniform_share: float = 0.15,
) -> Stages:
    """CVQ-MPT: the cheapest sequences of codes as a mixture.

    project_first: codes are projected before sequences are chosen, and sampled around there. update: steps of
    Algorithm 2 instead. cloud: of CLOUDS, in place of the scene's. Models of kind "published" have a sequence model of
    their own, whose codes Algorithm 2 moves in place of the projection.
    """
    if model_of(model).config.kind == "published":
        return published(robot, model, PredictorSettings(name=name), STEPS if project_first else update)
    code_roadmap(model, robot)  # a model without edge validity model is refused before the clock starts
    moved = None
    if update is not None:
        codebook = codebook_of(model, robot)
        moved = MovedGaussians(codebook, LatentOptimizer(codebook, LatentSettings(steps=update)))
    predict = PredictedSequences(
        name,
        lambda query: code_roadmap(model, query.space.robot, query.space.problem.attachments),
        widened(dictionary_roadmap(model, robot).covariances, WIDTH),
        uniform_share=uniform_share,
        project_first=project_first,
    )
    return Stages(predict=predict, observe=CLOUDS.get(cloud, observer(POINTS)), update=moved)


@dataclass(frozen=True, eq=False)
class MovedGaussians:
    """The update of Opt-CVQ-MPT (paper, Algorithm 2): the codes of a proposal moved towards the constraint."""

    codebook: Codebook
    optimizer: LatentOptimizer

    def __call__(self, query: Query, proposal: Proposal) -> Proposal:
        """Sample around the moved codes; the proposal itself where there is nothing to move."""
        assert isinstance(proposal, CodeProposal)
        mixture, robot = proposal.distribution, query.space.robot
        if query.space.dim == 0 or not isinstance(mixture, GaussianMixture):
            return proposal
        z, manifold = self.codebook.vectors[proposal.codes], query.space.problem.manifold
        moved = self.optimizer.optimize(z, manifold, query.rng)
        means, covariances = self.codebook.gaussians(moved.z)
        noise = code_noise(len(self.codebook.vectors), robot.dof)[proposal.codes]
        means = drawn_nodes(means, covariances, robot, noise)
        return replace(
            proposal,
            distribution=replace(mixture, means=means, covariances=widened(covariances, WIDTH)),
            timings=replace(proposal.timings, optimize=moved.seconds),
            detail=f"{proposal.detail}, G {moved.g_before.mean():.3g} to {moved.g_after.mean():.3g}, "
            f"{moved.kept.sum()} kept",
        )


def published(
    robot: Robot, model: str, settings: PredictorSettings = AS_PUBLISHED, update: int | None = None
) -> Stages:
    """CVQ-MPT by a model of the authors' architecture; Opt-CVQ-MPT after `update` steps of Algorithm 2."""
    predictor = _predictor(model, robot, settings)
    moved = None
    if update is not None:
        moved = MovedCodes(predictor, LatentOptimizer(predictor.codebook, LatentSettings(steps=update)))
    return Stages(predict=PredictedCodes(predictor), observe=observer(), update=moved)


@lru_cache(maxsize=16)
def _predictor(model: str, robot: Robot, settings: PredictorSettings) -> Predictor:
    return Predictor(model_of(model), robot, settings)


@dataclass(frozen=True, eq=False)
class PredictedProposal(CodeProposal):
    """A proposal that remembers the prediction it was made of."""

    prediction: Prediction | None = None


@dataclass(frozen=True, eq=False)
class PredictedCodes:
    """CVQ-MPT: codes predicted from cloud, start and goals become a mixture."""

    predictor: Predictor

    def __call__(self, query: Query, observation: Observation) -> PredictedProposal:
        """Predict; the timings say what the networks took."""
        assert observation.cloud is not None
        goals = query.nearest_goals(GOALS)
        prediction = self.predictor.predict(observation.cloud, query.start, goals, observation.use_cache)
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
    """The update of Opt-CVQ-MPT (paper, Algorithm 2) for published models."""

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


def roadmap_path(robot: Robot, model: str, cloud: str | None = None, oracle: bool = False) -> Stages:
    """The dictionary as a roadmap, projected node by node, searched for a path along edges that look free.

    cloud: of CLOUDS, in place of the scene's. oracle: no cloud, but what is blocked is known.
    """
    roadmap = dictionary_roadmap(model, robot)
    if cloud == "none" or oracle or EDGE_PART not in model_of(model).parts:
        return Stages(predict=RoadmapPath(roadmap, oracle=oracle))
    predict = RoadmapPath(roadmap, edge_model=partial(_edge_arrays, model))
    return Stages(predict=predict, observe=CLOUDS.get(cloud, observer(POINTS)))


def _edge_arrays(model: str, query: Query, observation: Observation) -> EdgeArrays:
    """The edge validity model for the query's robot, and what it carries, in the observed cloud."""
    assert observation.cloud is not None
    found = edge_model(model, query.space.robot, query.space.problem.attachments)
    return found.arrays(observation.cloud, observation.use_cache)


def true_codes(robot: Robot, model: str) -> Stages:
    """The codes of an unconstrained path of the very problem: a model that never errs."""
    means, covariances = dictionary_gaussians(model_of(model), robot)
    share = PredictorSettings().uniform_share

    def suggest(query: Query, path: JointPath) -> SamplingDistribution:
        codes = np.unique(codes_of(model_of(model), robot, path.spaced(0.2)))
        return GaussianMixture.equal(means[codes], covariances[codes], query.uniform, share, "true-codes")

    return Stages(predict=UnconstrainedPath(suggest))


def mpnet(robot: Robot, model: str, bridged: bool = False) -> Stages:
    """MPNet's rollouts as published; bridged: whatever rollouts leave open is joined by tree growth."""
    settings = BRIDGED if bridged else MPNetSettings()
    points = model_of(model, MPNET).config.n_points
    return Stages(predict=_rollouts(model, settings), observe=observer(points))


@lru_cache(maxsize=4)
def _rollouts(model: str, settings: MPNetSettings) -> MPNetRollouts:
    return MPNetRollouts(model_of(model, MPNET), settings)
