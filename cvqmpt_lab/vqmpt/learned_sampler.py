"""The learned sampler: the distribution that the search samples from, made of predicted codes.

With predicted codes h_1 ... h_c and goals q_1 ... q_k, samples are drawn from the mixture

    q ~ 1 / (c + k) (sum_i N(mu(z_hi), Sigma(z_hi)) + sum_j N(q_j, S)),   S^(1/2) = 0.1 diag(range),

and, with a given probability, uniformly (paper, eqn. sample_dist; the goals' Gaussians are only in
the published code). Weights, dictionaries and roadmaps are loaded once in a process, before the
time of planning is measured. A model is given by name or folder, see `weights.resolve_model`.
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
    Search,
    Stages,
    uniform,
    widened,
)
from cvqmpt_lab.search.result import Budget, JointPath, Timings
from cvqmpt_lab.search.roadmap import Roadmap, linked_roadmap
from cvqmpt_lab.sensing.observation import CameraSettings, Observer
from cvqmpt_lab.vqmpt.chosen_draws import ClearestDraws, Clearness, HalvedMixture
from cvqmpt_lab.vqmpt.code_nodes import code_noise, drawn_nodes
from cvqmpt_lab.vqmpt.code_predictors import (
    CodePredictor,
    CodeProposal,
    lines_to_nearest_goals,
    lines_to_predicted_goals,
    network_codes,
    oracle_codes,
    random_codes,
    ranked_goals,
    solved_path,
)
from cvqmpt_lab.vqmpt.codebook import Codebook, codes_of, dictionary_nodes
from cvqmpt_lab.vqmpt.latent_update import LatentOptimizer, LatentSettings
from cvqmpt_lab.vqmpt.mpnet_rollouts import MPNetNetwork, MPNetRollouts
from cvqmpt_lab.vqmpt.sampler_choice import SamplerChoice
from cvqmpt_lab.vqmpt.sequence_predictor import (
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
    name: str  # name of the distribution in result rows
    codebook: Codebook
    robot: Robot
    noise: np.ndarray  # (codes, n) standard normal, from which the codes' nodes are computed
    width: float = 1.1  # [rad] minimum standard deviation of wide Gaussians, tuned
    smallest_std: float = 1e-4  # [rad] minimum in any direction: covariances are positive definite
    goal_std: float = (
        0.1  # standard deviation around goals, share of each joint's range (published)
    )
    drift: float = 1.5  # [rad] maximum distance from a mean to its projection
    # returns the codes (b,) of configurations (b, n)
    encode: Callable[[np.ndarray], np.ndarray] | None = None
    # [rad] distance of encoded states along a path: 1 % of the Panda's joint space (published data)
    waypoint_spacing: float = 0.13
    along_spacing: float = 0.4  # [rad] distance of Gaussians along a polyline, tuned

    def gaussians(
        self, codes: np.ndarray, z: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return means (c, n) [rad] and covariances (c, n, n) [rad^2] of codes.

        Args:
            codes: (c,), rows of the dictionary.
            z: (c, code_dim), updated vectors of the codes; None: the dictionary's vectors.
        """
        z = self.codebook.vectors[codes] if z is None else z
        means, covariances = self.codebook.gaussians(z)
        positive = widened(covariances, self.smallest_std)
        if self.choice.gaussians == "decoded":
            return means, positive
        nodes = drawn_nodes(means, positive, self.robot, self.noise[codes])
        return nodes, widened(covariances, self.width)

    def mixture(
        self, query: Query, found: CodeProposal, means: np.ndarray, covariances: np.ndarray
    ) -> SamplingDistribution:
        """Return the mixture of these Gaussians and of Gaussians around goals, with its choices.

        Args:
            query: the query, with its uniform distribution.
            found: the prediction, with its goals (k, n) [rad or m].
            means: (c, n) [rad or m], in order of the sequence.
            covariances: (c, n, n), squared units.
        """
        goals = found.goals
        goal_covariance = np.diag((self.goal_std * (self.robot.upper - self.robot.lower)) ** 2)
        goal_covariances = np.broadcast_to(goal_covariance, (len(goals), *goal_covariance.shape))
        mixed = GaussianMixture.equal(
            np.concatenate([means, goals]),
            np.concatenate([covariances, goal_covariances]),
            query.uniform,
            self.choice.uniform_share,
            self.name,
        )
        assert isinstance(mixed, GaussianMixture)
        if self.choice.half == "own-half":
            return chosen_of(HalvedMixture.of(mixed, len(means)), query, found.cloud)
        return chosen_of(mixed, query, found.cloud)

    def propose(self, query: Query, observation: Observation) -> CodeProposal:
        """Return the sampling distribution of predicted codes, before any update: CVQ-MPT.

        If no code was predicted, it is uniform, and the proposal's `fallback` says so.
        """
        found = self.predict(query, observation)
        if self.choice.chosen == "clearest-draw":
            found = replace(found, cloud=observation.cloud)
        if len(found.codes) == 0 and not found.polylines:
            uniform_draws = chosen_of(found.distribution, query, found.cloud)
            fallback = "no code sequence reached a goal"
            return replace(found, distribution=uniform_draws, fallback=fallback)
        if self.choice.gaussians == "along":
            along = self.along(query, found.polylines)
            return replace(found, distribution=chosen_of(along, query, found.cloud))
        if self.choice.reading == "every-waypoint":
            found = self.every_waypoint(query, found)
        mixture = self.mixture(query, found, *self.gaussians(found.codes))
        return replace(found, distribution=mixture)

    def along(self, query: Query, polylines: tuple[np.ndarray, ...]) -> SamplingDistribution:
        """Return Gaussians N(q, std^2 I) of equal weight at states q along polylines (s, n)."""
        means = np.concatenate([JointPath(line).spaced(self.along_spacing) for line in polylines])
        covariance = self.choice.std**2 * np.eye(means.shape[1])
        share = self.choice.uniform_share
        return GaussianMixture.equal(means, covariance, query.uniform, share, self.name)

    def every_waypoint(self, query: Query, found: CodeProposal) -> CodeProposal:
        """Replace codes by the codes of all states along the polylines, without repeated ones.

        The authors encode every waypoint of interpolated paths, so their sequences have codes at
        this spacing. Ours are trained with one code for each node.
        """
        assert self.encode is not None
        began, codes_of_lines = query.deadline.seconds, []
        for line in found.polylines:
            codes = self.encode(JointPath(line).spaced(self.waypoint_spacing))
            changes = np.flatnonzero(np.diff(codes)) + 1
            codes_of_lines.append(codes[np.concatenate([[0], changes])])
        codes = np.concatenate(codes_of_lines)
        predict = (found.timings.predict or 0.0) + query.deadline.seconds - began
        detail = f"codes of every waypoint: {len(codes)}"
        if found.detail:
            detail = f"{found.detail}, {detail}"
        timings = replace(found.timings, predict=predict)
        return replace(found, codes=codes, timings=timings, detail=detail)

    def optimized(self, optimizer: LatentOptimizer, query: Query, proposal: Proposal) -> Proposal:
        """Move the codes by z <- z - eta dE[F^T F]/dz (paper, Algorithm 2), and decode them.

        Without codes or without constraint, the proposal is returned unchanged.
        """
        assert isinstance(proposal, CodeProposal)
        constraint = query.space.constraint
        if constraint is None or query.space.dim == 0 or len(proposal.codes) == 0:
            return proposal
        vectors = self.codebook.vectors[proposal.codes]
        result = optimizer.optimize(vectors, constraint, query.rng)
        before, after = result.g_before.mean(), result.g_after.mean()
        gaussians = self.gaussians(proposal.codes, result.z)
        return replace(
            proposal,
            distribution=self.mixture(query, proposal, *gaussians),
            timings=replace(proposal.timings, optimize=result.seconds),
            detail=f"{proposal.detail}, G {before:.3g} to {after:.3g}, {result.kept.sum()} kept",
        )

    def projected(self, query: Query, proposal: Proposal) -> Proposal:
        """Project the means by q <- q - J^+ F(q) (paper, Algorithm 1); covariances are unchanged.

        Codes whose mean cannot be projected, or moves by more than `drift`, are left out. Without
        codes or without constraint, the proposal is returned unchanged.
        """
        assert isinstance(proposal, CodeProposal)
        if query.space.dim == 0 or len(proposal.codes) == 0:
            return proposal
        began = query.deadline.seconds
        means, covariances = self.gaussians(proposal.codes)
        near = np.zeros(len(means), dtype=bool)
        for row, mean in enumerate(means):
            q = mean.copy()
            # a mean that moves far no longer represents the part of the space that was predicted
            near[row] = query.space.project(q) and np.linalg.norm(q - mean) <= self.drift
            means[row] = q
        mixture = self.mixture(query, proposal, means[near], covariances[near])
        return replace(
            proposal,
            distribution=mixture if near.any() else query.uniform,
            timings=replace(proposal.timings, optimize=query.deadline.seconds - began),
            detail=f"{proposal.detail}, {near.sum()} on the manifold",
            fallback=proposal.fallback if near.any() else "no code lies near the manifold",
        )


def chosen_of(
    drawn: SamplingDistribution, query: Query, cloud: np.ndarray | None
) -> SamplingDistribution:
    """Return the clearest draws of a distribution in a cloud (m, 3) [m]; without one, itself."""
    return drawn if cloud is None else ClearestDraws(drawn, Clearness(query.space, cloud))


def clearest_uniform(query: Query, observation: Observation) -> Proposal:
    """Propose the clearest of uniform draws."""
    return Proposal(chosen_of(query.uniform, query, observation.cloud))


@lru_cache(maxsize=4)
def model_of(model: str, architecture: str = VQ_MPT) -> StoredModel:
    """Read weights without the scene transformer's arrays, which `sequence_predictor` reads."""
    folder = resolve_model(model, architecture)
    return read_model(folder, architecture=architecture, left_out=TRANSFORMER)


@lru_cache(maxsize=8)
def codebook_of(model: str, robot: Robot) -> Codebook:
    """Return the dictionary of a model."""
    return Codebook(model_of(model), robot)


@lru_cache(maxsize=8)
def dictionary_roadmap(model: str, robot: Robot) -> Roadmap:
    """Build the dictionary's roadmap; its nodes are one configuration from each code's Gaussian."""
    stored = model_of(model)
    stored.robot.require_same(robot_signature(robot))
    return Roadmap.of(dictionary_nodes(stored, robot))


@lru_cache(maxsize=8)
def free_dictionary(model: str, robot: Robot, attachments: tuple[Attachment, ...] = ()) -> Roadmap:
    """Build the dictionary's roadmap without nodes and edges in self-collision."""
    return linked_roadmap(robot, attachments, dictionary_roadmap(model, robot).nodes)


@lru_cache(maxsize=4)
def observer(points: int | None = None) -> Observer:
    """Make an observer whose clouds have this number of points; None: as many as in training."""
    return Observer(CameraSettings.like_training(points) if points else None)


@lru_cache(maxsize=4)
def sequence_predictor(model: str, robot: Robot, published: bool) -> SequencePredictor:
    """Load a model's scene transformer, or its sequence model of the authors' architecture."""
    if published:
        return PublishedPredictor(model_of(model), robot)
    return SceneTransformerPredictor(load_vq_mpt(robot, model), robot)


@lru_cache(maxsize=4)
def mpnet_network(model: str) -> MPNetNetwork:
    """Load a trained MPNet."""
    return MPNetNetwork(model_of(model, MPNET))


def learned(
    robot: Robot,
    model: str,
    name: str,
    choice: SamplerChoice,
    other_scene: Scene | None = None,
) -> Stages:
    """Return the stages of a planner with a learned sampler.

    Args:
        robot: robot of the problem and of the weights.
        model: name or folder of the weights.
        name: name of the distribution in result rows.
        choice: predictor, Gaussians, update, cloud and uniform share.
        other_scene: scene whose cloud the network gets if the choice is ``other-cloud``.

    Raises:
        InvalidInputError: the weights lack a part that the predictor needs, or are for another
            robot.
    """
    search, limits = _host(choice)
    apart = choice.goals != "goals-together"
    clearest = choice.chosen == "clearest-draw"
    # ablations see no cloud, or another's
    observe: Callable[[Scene], np.ndarray] | None = observer() if clearest else None
    if choice.predictor == "uniform":
        predict_uniform = clearest_uniform if clearest else uniform
        return Stages(predict_uniform, search, observe, goals_apart=apart, goal_limits=limits)
    codebook = codebook_of(model, robot)
    encode = partial(codes_of, model_of(model), robot)
    predictors: dict[str, CodePredictor] = {
        "random": partial(random_codes, len(codebook.vectors)),
        "solved": solved_path,
        "nearest-lines": lines_to_nearest_goals,
        "oracle": partial(oracle_codes, encode),
    }
    predict = predictors.get(choice.predictor)
    rank: Callable[[Query, Observation], tuple[np.ndarray, Timings]] | None = None
    if predict is None:
        predictor = sequence_predictor(model, robot, choice.predictor == "published")
        nodes = dictionary_nodes(model_of(model), robot)
        rank = partial(_ranked, predictor)
        predict = partial(network_codes, predictor, choice.sequences == "all-beams", nodes)
        if choice.predictor == "transformer-lines":
            predict = partial(lines_to_predicted_goals, predict)
        observed = observer()
        clouds: dict[str, Callable[[Scene], np.ndarray]] = {
            "own-cloud": observed,
            "no-cloud": lambda scene: np.empty((0, 3)),
        }
        if other_scene is not None:
            clouds["other-cloud"] = lambda scene: observed(other_scene)
        observe = clouds.get(choice.cloud)
        if observe is None:
            raise InvalidInputError(
                f"{name}: other-cloud needs another scene; choose own-cloud or no-cloud"
            )
    noise = code_noise(len(codebook.vectors), robot.dof)
    sampler = LearnedSampler(predict, choice, name, codebook, robot, noise, encode=encode)
    update: Callable[[Query, Proposal], Proposal] | None = None
    if choice.update == "projected":
        update = sampler.projected
    elif choice.update == "algorithm-2":
        update = partial(sampler.optimized, LatentOptimizer(codebook, LatentSettings()))
    elif choice.update == "printed":
        settings = LatentSettings(method="gradient", put_back=False)
        update = partial(sampler.optimized, LatentOptimizer(codebook, settings))
    return Stages(
        sampler.propose,
        search,
        observe,
        update,
        goals_apart=apart,
        goal_limits=limits,
        rank_goals=rank if choice.goals == "goals-ranked" else None,
    )


def _ranked(
    predictor: SequencePredictor, query: Query, observation: Observation
) -> tuple[np.ndarray, Timings]:
    """Return the goals of a query by predicted cost, and the time that this took."""
    _, goals, timings = ranked_goals(predictor, query, observation)
    return goals, timings


def _host(choice: SamplerChoice) -> tuple[Search, tuple[Budget, ...]]:
    """Return the search that draws the samples, and the limits for each goal."""
    # 20 goals use up 100 s in the second round, one goal in the sixth
    tries = tuple(Budget(cost=2.5 * 2**k) for k in range(6))
    again = choice.goals in ("goals-again", "goals-ranked")
    if choice.host == "in-birrt":
        search = BiRRT(reach=choice.reach, draws=choice.draws.removesuffix("-draws"))
        return search, tries if again else ()
    from cvqmpt_lab.search.ompl_planners import GOAL_LIMIT, published_search  # takes 0.3 s

    search_in_ompl = published_search(choice.reach, choice.draws == "free-draws")
    if again:
        return search_in_ompl, tries
    return search_in_ompl, (GOAL_LIMIT,) if choice.goals == "goals-apart" else ()


def mpnet(robot: Robot, model: str, bridged: bool = False, in_ompl: bool = False) -> Stages:
    """Return the stages of MPNet.

    Args:
        robot: robot of the problem and of the weights.
        model: name or folder of the weights.
        bridged: connect sides that did not meet by tree growth, with 10 rollouts instead of 50.
        in_ompl: neighbouring states are joined by OMPL's RRTConnect, as published.
    """
    network = mpnet_network(model)
    if in_ompl:
        from cvqmpt_lab.search.ompl_planners import published_search

        limit = Budget(cost=5.0)  # of the published code, for two states
        rollouts = MPNetRollouts(network, pair_limit=limit, direct=False, joins=published_search())
    elif bridged:
        rollouts = MPNetRollouts(network, bridged, rollouts=10)
    else:
        rollouts = MPNetRollouts(network)
    return Stages(predict=rollouts, observe=observer(network.config.n_points))
