"""The learned sampler: predicted codes become the distribution that the search samples from.

With predicted codes h_1 ... h_c and the goals q_1 ... q_k of the query, samples are drawn from

    q ~ 1 / (c + k) (sum_i N(mu(z_hi), Sigma(z_hi)) + sum_j N(q_j, S)),   S^(1/2) = 0.1 diag(range),

and a uniform share (paper, eqn. sample_dist; only the published code has the goals). Weights,
dictionaries and roadmaps are loaded once per process, before any clock starts. A model is a name or
folder as `weights.resolve_model` takes it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.planner_interface import (
    GaussianMixture,
    Observation,
    Proposal,
    Query,
    SamplingDistribution,
    Stages,
    uniform,
    widened,
)
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.roadmap import Roadmap, linked_roadmap
from cvqmpt_lab.sensing.observation import CameraSettings, Observer
from cvqmpt_lab.vqmpt.code_predictors import (
    CodePredictor,
    CodeProposal,
    lines_to_nearest_goals,
    lines_to_predicted_goals,
    network_codes,
    oracle_codes,
    random_codes,
    solved_way,
)
from cvqmpt_lab.vqmpt.codebook import (
    Codebook,
    code_noise,
    codes_of,
    dictionary_nodes,
    drawn_nodes,
)
from cvqmpt_lab.vqmpt.latent_update import LatentOptimizer, LatentSettings
from cvqmpt_lab.vqmpt.mpnet_rollouts import MPNetNetwork, MPNetRollouts
from cvqmpt_lab.vqmpt.sampler_choice import SamplerChoice
from cvqmpt_lab.vqmpt.scene_predictor import (
    PublishedPredictor,
    SceneTransformerPredictor,
    SequencePredictor,
)
from cvqmpt_lab.vqmpt.weights import (
    MPNET,
    TRANSFORMER,
    VQ_MPT,
    StoredModel,
    load_vq_mpt,
    read_model,
    resolve_model,
    robot_signature,
)


@dataclass(frozen=True, eq=False)
class LearnedSampler:
    """Mixture of the Gaussians of predicted codes (paper, eqn. sample_dist), and its updates."""

    predict: CodePredictor
    choice: SamplerChoice
    name: str  # what result rows call the distribution
    codebook: Codebook
    robot: Robot
    noise: np.ndarray  # (codes, n) standard normal: where in its Gaussian each code's node lies
    width: float = 1.1  # [rad] least standard deviation of wide Gaussians, from tuning
    smallest_std: float = 1e-4  # [rad] in any direction, so that covariances stay positive definite
    goal_std: float = 0.1  # of goals' Gaussians, share of each joint's range (published code)
    drift: float = 1.5  # [rad] that a projected mean may move; others are left out
    # gives the codes (b,) of configurations (b, n) along a path
    read: Callable[[np.ndarray], np.ndarray] | None = None
    # [rad] between states of a path whose codes are read: 1 % of the Panda's space (published data)
    waypoint_spacing: float = 0.13
    along_spacing: float = 0.4  # [rad] between Gaussians along a sequence, from tuning

    def gaussians(
        self, codes: np.ndarray, z: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Means (c, n) [rad] and covariances (c, n, n) [rad^2] of codes.

        Args:
            codes: (c,) rows of the dictionary.
            z: (c, code_dim), the codes' vectors after an update; None for the dictionary's.
        """
        z = self.codebook.vectors[codes] if z is None else z
        means, covariances = self.codebook.gaussians(z)
        positive = widened(covariances, self.smallest_std)
        if self.choice.gaussians == "decoded":
            return means, positive
        nodes = drawn_nodes(means, positive, self.robot, self.noise[codes])
        return nodes, widened(covariances, self.width)

    def mixture(
        self, query: Query, goals: np.ndarray, means: np.ndarray, covariances: np.ndarray
    ) -> GaussianMixture:
        """The mixture of these Gaussians and one around each of goals (k, n)."""
        spread = np.diag((self.goal_std * (self.robot.upper - self.robot.lower)) ** 2)
        around = np.broadcast_to(spread, (len(goals), *spread.shape))
        every = np.concatenate([means, goals]), np.concatenate([covariances, around])
        mixed = GaussianMixture.equal(*every, query.uniform, self.choice.uniform_share, self.name)
        assert isinstance(mixed, GaussianMixture)
        return mixed

    def propose(self, query: Query, observation: Observation) -> CodeProposal:
        """The sampling distribution of predicted codes before any update: CVQ-MPT.

        If no code was predicted: uniform samples, and a note of this fallback.
        """
        found = self.predict(query, observation)
        if len(found.codes) == 0 and not found.ways:
            return replace(found, fallback="no code sequence reached a goal")
        if self.choice.gaussians == "along":
            return replace(found, distribution=self.along(query, found.ways))
        if self.choice.reading == "every-waypoint":
            found = self.every_waypoint(query, found)
        mixture = self.mixture(query, found.goals, *self.gaussians(found.codes))
        return replace(found, distribution=mixture)

    def along(self, query: Query, ways: tuple[np.ndarray, ...]) -> SamplingDistribution:
        """Gaussians N(q, std^2 I) of equal weight at states q along polylines (s, n)."""
        means = np.concatenate([JointPath(way).spaced(self.along_spacing) for way in ways])
        covariance = self.choice.std**2 * np.eye(means.shape[1])
        share = self.choice.uniform_share
        return GaussianMixture.equal(means, covariance, query.uniform, share, self.name)

    def every_waypoint(self, query: Query, found: CodeProposal) -> CodeProposal:
        """Codes of the states along each sequence's nodes, where runs of equal codes are one.

        The authors encode every waypoint of interpolated paths, so that their sequences are read
        off at this spacing; ours are trained on one code a node.
        """
        assert self.read is not None
        began, listed = query.deadline.seconds, []
        for way in found.ways:
            codes = self.read(JointPath(way).spaced(self.waypoint_spacing))
            changes = np.flatnonzero(np.diff(codes)) + 1
            listed.append(codes[np.concatenate([[0], changes])])
        codes = np.concatenate(listed)
        predict = (found.timings.predict or 0.0) + query.deadline.seconds - began
        return replace(
            found,
            codes=codes,
            timings=replace(found.timings, predict=predict),
            detail=", ".join(filter(None, (found.detail, f"{len(codes)} of every waypoint"))),
        )

    def moved(self, optimizer: LatentOptimizer, query: Query, proposal: Proposal) -> Proposal:
        """Codes moved by z <- z - eta dE[F^T F]/dz (paper, Algorithm 2), then decoded.

        Without codes or constraint: the proposal itself.
        """
        assert isinstance(proposal, CodeProposal)
        constraint = query.space.constraint
        if constraint is None or query.space.dim == 0 or len(proposal.codes) == 0:
            return proposal
        vectors = self.codebook.vectors[proposal.codes]
        moved = optimizer.optimize(vectors, constraint, query.rng)
        before, after = moved.g_before.mean(), moved.g_after.mean()
        gaussians = self.gaussians(proposal.codes, moved.z)
        return replace(
            proposal,
            distribution=self.mixture(query, proposal.goals, *gaussians),
            timings=replace(proposal.timings, optimize=moved.seconds),
            detail=f"{proposal.detail}, G {before:.3g} to {after:.3g}, {moved.kept.sum()} kept",
        )

    def projected(self, query: Query, proposal: Proposal) -> Proposal:
        """Means projected by q <- q - J^+ F(q) (paper, Algorithm 1), with unchanged covariances.

        Codes whose mean does not reach the manifold are left out. Without codes or constraint: the
        proposal itself.
        """
        assert isinstance(proposal, CodeProposal)
        if query.space.dim == 0 or len(proposal.codes) == 0:
            return proposal
        began = query.deadline.seconds
        means, covariances = self.gaussians(proposal.codes)
        near = np.zeros(len(means), dtype=bool)
        for row, mean in enumerate(means):
            q = mean.copy()
            # a mean that moves far stands for another part of the space
            near[row] = query.space.project(q) and np.linalg.norm(q - mean) <= self.drift
            means[row] = q
        mixture = self.mixture(query, proposal.goals, means[near], covariances[near])
        return replace(
            proposal,
            distribution=mixture if near.any() else query.uniform,
            timings=replace(proposal.timings, optimize=query.deadline.seconds - began),
            detail=f"{proposal.detail}, {near.sum()} on the manifold",
            fallback=proposal.fallback if near.any() else "no code lies near the manifold",
        )


@lru_cache(maxsize=4)
def model_of(model: str, architecture: str = VQ_MPT) -> StoredModel:
    """Weights without the transformer's arrays, which are not needed once it is built."""
    folder = resolve_model(model, architecture)
    return read_model(folder, architecture=architecture, left_out=TRANSFORMER)


@lru_cache(maxsize=8)
def codebook_of(model: str, robot: Robot) -> Codebook:
    """The dictionary's codes as Gaussians."""
    return Codebook(model_of(model), robot)


@lru_cache(maxsize=8)
def dictionary_roadmap(model: str, robot: Robot) -> Roadmap:
    """A roadmap whose nodes are one configuration drawn from each code's Gaussian."""
    stored = model_of(model)
    stored.robot.require_same(robot_signature(robot))
    return Roadmap.of(dictionary_nodes(stored, robot))


@lru_cache(maxsize=8)
def free_dictionary(model: str, robot: Robot, attachments: tuple[Attachment, ...] = ()) -> Roadmap:
    """The same without what collides with itself."""
    return linked_roadmap(robot, attachments, dictionary_roadmap(model, robot).nodes)


@lru_cache(maxsize=4)
def observer(points: int | None = None) -> Observer:
    """Renders clouds of that many points, or as many as point encoders were trained on."""
    return Observer(CameraSettings.like_training(points) if points else None)


@lru_cache(maxsize=4)
def sequence_predictor(model: str, robot: Robot, published: bool) -> SequencePredictor:
    """The scene transformer of a model, or its sequence model of the authors' architecture."""
    if published:
        return PublishedPredictor(model_of(model), robot)
    return SceneTransformerPredictor(load_vq_mpt(robot, model), robot)


@lru_cache(maxsize=4)
def mpnet_network(model: str) -> MPNetNetwork:
    """A trained MPNet."""
    return MPNetNetwork(model_of(model, MPNET))


def learned(
    robot: Robot,
    model: str,
    name: str,
    choice: SamplerChoice,
    other_scene: Scene | None = None,
) -> Stages:
    """The stages of a learned sampler.

    Args:
        robot: that the weights must be of.
        model: name or folder of the weights.
        name: what result rows call the distribution.
        choice: predictor, Gaussians, update, cloud and uniform share.
        other_scene: whose cloud the network gets where the cloud is ``other-cloud``.

    Raises:
        InvalidInputError: the weights lack what the predictor needs, or are another robot's.
    """
    search = BiRRT(reach=choice.reach, draws=choice.draws.removesuffix("-draws"))
    apart = choice.goals == "goals-apart"
    if choice.predictor == "uniform":
        return Stages(uniform, search, goals_apart=apart)
    codebook = codebook_of(model, robot)
    read = partial(codes_of, model_of(model), robot)
    predictors: dict[str, CodePredictor] = {
        "random": partial(random_codes, len(codebook.vectors)),
        "solved": solved_way,
        "nearest-lines": lines_to_nearest_goals,
        "oracle": partial(oracle_codes, read),
    }
    predict = predictors.get(choice.predictor)
    observe: Callable[[Scene], np.ndarray] | None = None
    if predict is None:
        predictor = sequence_predictor(model, robot, choice.predictor == "published")
        nodes = dictionary_nodes(model_of(model), robot)
        predict = partial(network_codes, predictor, choice.sequences == "all-beams", nodes)
        if choice.predictor == "transformer-lines":
            predict = partial(lines_to_predicted_goals, predict)
        if choice.cloud == "own-cloud":
            observe = observer()
        elif choice.cloud == "no-cloud":
            observe = _no_points
        elif other_scene is not None:
            observe = partial(_cloud_of, other_scene)
        else:
            raise InvalidInputError(f"{name}: other-cloud needs a scene whose cloud is taken")
    noise = code_noise(len(codebook.vectors), robot.dof)
    sampler = LearnedSampler(predict, choice, name, codebook, robot, noise, read=read)
    updates: dict[str, Callable[[Query, Proposal], Proposal] | None] = {
        "none": None,
        "algorithm-2": partial(sampler.moved, LatentOptimizer(codebook, LatentSettings())),
        "printed": partial(
            sampler.moved,
            LatentOptimizer(codebook, LatentSettings(method="gradient", put_back=False)),
        ),
        "projected": sampler.projected,
    }
    return Stages(sampler.propose, search, observe, updates[choice.update], goals_apart=apart)


def _no_points(scene: Scene) -> np.ndarray:
    """No points (0, 3), whatever the scene: a control."""
    return np.empty((0, 3))


def _cloud_of(other_scene: Scene, scene: Scene) -> np.ndarray:
    """The cloud (4096, 3) [m] of another scene: a control."""
    return observer(4096)(other_scene)


def mpnet(robot: Robot, model: str, bridged: bool = False) -> Stages:
    """MPNet's rollouts, 50 as published; bridged: 10, connected with bidirectional RRT."""
    network = mpnet_network(model)
    rollouts = MPNetRollouts(network, bridged, rollouts=10) if bridged else MPNetRollouts(network)
    return Stages(predict=rollouts, observe=observer(network.config.n_points))
