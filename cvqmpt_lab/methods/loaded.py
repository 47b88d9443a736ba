"""Weights, dictionaries, eyes and observers: loaded or made once a process, before any clock starts."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.methods.method import Weights
from cvqmpt_lab.methods.observation import Observer
from cvqmpt_lab.planning.code_graph import SeenGraph
from cvqmpt_lab.planning.roadmap import Roadmap
from cvqmpt_lab.planning.sight import Eyes
from cvqmpt_lab.planning.small_network import SmallNetwork
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import family_scene
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.sensing.virtual import CameraSettings
from cvqmpt_lab.vqmpt.codebook import Codebook, dictionary_gaussians, drawn_nodes
from cvqmpt_lab.vqmpt.weights import SHIPPED, StoredModel, read_model, resolve_model

EYES = "sight"
"""Part of a model that prices edges."""
ROADMAP_DRAW = 4  # seed of the draw from the dictionary, the best of six on the tuning environments
POINTS_SEEN = 4096  # of a cloud that distances are measured to
WRONG_SCENE = ("shelves", 77)  # shown to the model in place of the problem's own scene


@lru_cache(maxsize=4)
def model_of(weights: Weights) -> StoredModel:
    """The weights of a method."""
    of = SHIPPED[weights.kind]
    return read_model(resolve_model(weights.model or weights.kind, of), architecture=of)


@lru_cache(maxsize=1)
def observer() -> Observer:
    """Sees what networks with a cloud encoder were trained on."""
    return Observer()


@lru_cache(maxsize=1)
def wide_observer() -> Observer:
    """Sees what eyes look at."""
    return Observer(CameraSettings.like_training(POINTS_SEEN))


def another_scene(problem: PlanningProblem) -> np.ndarray:
    """The cloud of another scene than the problem's."""
    return wide_observer()(replace(problem, scene=family_scene(*WRONG_SCENE)))


def no_cloud(problem: PlanningProblem) -> np.ndarray:
    """No cloud at all."""
    return np.empty((0, 3))


@lru_cache(maxsize=8)
def eyes_of(weights: Weights, robot: Robot, attachments: tuple[Attachment, ...] = ()) -> Eyes:
    """A model's eyes on a robot and what it carries; InvalidInputError where it has none."""
    parts = model_of(weights).parts
    if EYES not in parts:
        raise InvalidInputError(
            f"{weights.model or weights.kind} has no {EYES}, only {', '.join(parts)}; train some with "
            f"cvqmpt train {EYES}"
        )
    return Eyes(SmallNetwork.of(parts[EYES]), robot, attachments)


@lru_cache(maxsize=8)
def dictionary_roadmap(weights: Weights, robot: Robot) -> Roadmap:
    """The dictionary: one configuration drawn from each code's Gaussian."""
    means, covariances = dictionary_gaussians(model_of(weights), robot)
    return Roadmap.of(drawn_nodes(means, covariances, robot, drawn_noise(len(means), robot.dof)), covariances)


def drawn_noise(codes: int, n: int) -> np.ndarray:
    """Standard normal (codes, n): where in its Gaussian each code's node lies."""
    return np.random.default_rng(ROADMAP_DRAW).standard_normal((codes, n))


@lru_cache(maxsize=8)
def seen_dictionary(weights: Weights, robot: Robot, attachments: tuple[Attachment, ...] = ()) -> SeenGraph:
    """The dictionary before a model's eyes."""
    bare = seen_dictionary(weights, robot) if attachments else None
    return SeenGraph(dictionary_roadmap(weights, robot), eyes_of(weights, robot, attachments), bare)


@lru_cache(maxsize=8)
def codebook_of(weights: Weights, robot: Robot) -> Codebook:
    """The dictionary's codes as Gaussians."""
    return Codebook(model_of(weights), robot)
