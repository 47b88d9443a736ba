"""The learned planners on the shipped weights, loaded once a process, and their variants for ablation."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from cvqmpt_lab.constraints.task_space_region import RegionConstraint
from cvqmpt_lab.methods.controls import TrueCodes
from cvqmpt_lab.methods.learned_birrt import LearnedBiRRT
from cvqmpt_lab.methods.mpnet_planner import MPNetPlanner
from cvqmpt_lab.methods.observation import CloudOf, Observer
from cvqmpt_lab.models.checkpoint import Checkpoint
from cvqmpt_lab.planning.roadmap import Dictionary, RoadmapGuided, RoadmapSearch
from cvqmpt_lab.prediction.collision_head import free_probability
from cvqmpt_lab.prediction.dictionary_gaussians import dictionary_gaussians, drawn_nodes
from cvqmpt_lab.prediction.latent_optimizer import LatentOptimizer, LatentSettings
from cvqmpt_lab.prediction.predictor import Predictor, PredictorSettings
from cvqmpt_lab.prediction.shipped import load_shipped, load_shipped_mpnet
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import panda
from cvqmpt_lab.scene.families import family_scene

ROADMAP_DRAW = 4  # seed of the draw from the dictionary, the best of six on the tuning environments
BELIEVED = 0.5  # P(free) below which a node is left out
CHOSEN = {"decoding": "beam", "std_floor": 0.8, "uniform_share": 0.5}
"""Predictor settings of the planners, chosen on the tuning environments: as predicted, the mixture is too narrow."""
WRONG_SCENE = ("shelves", 77)  # shown to the model in place of the problem's own scene


@lru_cache(maxsize=1)
def _checkpoint() -> Checkpoint:
    return load_shipped(panda())


@lru_cache(maxsize=1)
def _observer() -> Observer:
    return Observer()


def _wrong_cloud(problem: PlanningProblem) -> np.ndarray:
    """The cloud of another scene."""
    return _observer()(replace(problem, scene=family_scene(*WRONG_SCENE)))


@lru_cache(maxsize=8)
def _predictor(settings: PredictorSettings) -> Predictor:
    return Predictor(_checkpoint(), panda(), settings)


def learned_birrt(
    name: str,
    update: LatentSettings | None = None,
    cloud_of: CloudOf | None = None,
    **settings: object,
) -> LearnedBiRRT:
    """CVQ-MPT with predictor settings of its own; Opt-CVQ-MPT with the update's."""
    predictor = _predictor(PredictorSettings(name=name, **{**CHOSEN, **settings}))  # type: ignore[arg-type]
    optimizer = None if update is None else LatentOptimizer(predictor, update)
    return LearnedBiRRT(predictor, cloud_of or _observer(), optimizer, name=name)


def wrong_cloud(name: str) -> LearnedBiRRT:
    """CVQ-MPT that is shown another scene."""
    return learned_birrt(name, cloud_of=_wrong_cloud)


def true_codes() -> TrueCodes:
    """The codes of an unconstrained path instead of predicted ones."""
    return TrueCodes(_predictor(PredictorSettings(**CHOSEN)))  # type: ignore[arg-type]


@lru_cache(maxsize=1)
def _dictionary() -> Dictionary:
    robot = panda()
    means, covariances = dictionary_gaussians(_checkpoint(), robot)
    return Dictionary.of(
        drawn_nodes(means, covariances, robot, np.random.default_rng(ROADMAP_DRAW)), covariances
    )


def roadmap_cvq() -> RoadmapSearch:
    """The dictionary, projected on the manifold node by node, searched for a path."""
    return RoadmapSearch(_dictionary())


def roadmap_sampler(name: str, check: bool, head: bool = False, update: bool = False) -> RoadmapGuided:
    """Unconstrained roadmap paths as a sampling distribution; without checks, the blind twin.

    head: nodes that the model believes blocked are left out. update: the codes are moved to the manifold.
    """
    blocked, move = _believed_blocked if head else None, _moved if update else None
    return RoadmapGuided(_dictionary(), name, check, blocked=blocked, move=move)


def _believed_blocked(problem: PlanningProblem) -> np.ndarray:
    """Nodes (N,) of the dictionary that the collision head calls blocked, from the cloud."""
    return free_probability(_checkpoint(), panda(), _observer()(problem), _dictionary().nodes) < BELIEVED


def _moved(
    problem: PlanningProblem, codes: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians of codes (r,) after the latent update towards the problem's constraint."""
    predictor = _predictor(PredictorSettings())
    z = predictor.checkpoint.dictionary.quantizer.embedding.weight.detach().numpy()[codes]
    constraint = RegionConstraint(problem.robot, tuple(problem.constraint))
    moved = LatentOptimizer(predictor).optimize_codes(z, None, constraint, rng)
    gaussians, model = predictor.decoder.decode(moved.z, None), predictor.configurations
    means = model.radians(gaussians.mean.astype(float))
    return means, gaussians.covariance * np.outer(model.range, model.range)


@lru_cache(maxsize=1)
def mpnet() -> MPNetPlanner:
    """MPNet on the shipped weights."""
    return MPNetPlanner(load_shipped_mpnet(panda()))
