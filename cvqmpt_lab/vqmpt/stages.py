"""Stages of planners with trained weights: what they observe, predict and update with.

Weights, dictionaries and roadmaps are loaded once a process, before any clock starts. A model is a
name or folder as `weights.resolve_model` takes it.
"""

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np

from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import another_scene
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.search.planner_interface import Proposal, Query, Stages
from cvqmpt_lab.search.roadmap import Roadmap
from cvqmpt_lab.search.roadmap_nodes import linked_roadmap
from cvqmpt_lab.sensing.observation import Observer
from cvqmpt_lab.sensing.virtual import CameraSettings
from cvqmpt_lab.vqmpt.code_predictors import (
    oracle_codes,
    published_codes,
    random_codes,
    transformer_codes,
)
from cvqmpt_lab.vqmpt.codebook import (
    Codebook,
    code_noise,
    codes_of,
    dictionary_gaussians,
    drawn_nodes,
)
from cvqmpt_lab.vqmpt.latent_update import LatentOptimizer, LatentSettings
from cvqmpt_lab.vqmpt.learned_sampler import CodePredictor, LearnedSampler
from cvqmpt_lab.vqmpt.mpnet_rollouts import MPNetRollouts
from cvqmpt_lab.vqmpt.predictor import Predictor
from cvqmpt_lab.vqmpt.sampler_choice import SamplerChoice
from cvqmpt_lab.vqmpt.scene_predictor import SceneTransformerPredictor
from cvqmpt_lab.vqmpt.weights import (
    MPNET,
    TRANSFORMER,
    VQ_MPT,
    StoredModel,
    load_vq_mpt,
    read_model,
    resolve_model,
)

POINTS = 4096  # of the other scene's cloud
STEPS = 5  # of Algorithm 2


@lru_cache(maxsize=4)
def model_of(model: str, architecture: str = VQ_MPT) -> StoredModel:
    """The weights of that name or folder but the transformer, whose arrays nobody needs once it is
    made of them.
    """
    return read_model(
        resolve_model(model, architecture), architecture=architecture, left_out=TRANSFORMER
    )


@lru_cache(maxsize=8)
def codebook_of(model: str, robot: Robot) -> Codebook:
    """The dictionary's codes as Gaussians."""
    return Codebook(model_of(model), robot)


@lru_cache(maxsize=8)
def dictionary_roadmap(model: str, robot: Robot) -> Roadmap:
    """The dictionary: one configuration drawn from each code's Gaussian."""
    means, covariances = dictionary_gaussians(model_of(model), robot)
    return Roadmap.of(drawn_nodes(means, covariances, robot, code_noise(len(means), robot.dof)))


@lru_cache(maxsize=8)
def free_dictionary(model: str, robot: Robot, attachments: tuple[Attachment, ...] = ()) -> Roadmap:
    """The same without what collides with itself."""
    return linked_roadmap(robot, attachments, dictionary_roadmap(model, robot).nodes)


@lru_cache(maxsize=4)
def observer(points: int | None = None) -> Observer:
    """Renders clouds of that many points, or as many as point encoders were trained on."""
    return Observer(CameraSettings.like_training(points) if points else None)


def other_scene(scene: Scene) -> np.ndarray:
    """The cloud of another scene, whatever the scene."""
    return observer(POINTS)(another_scene())


def no_cloud(scene: Scene) -> np.ndarray:
    """No points (0, 3)."""
    return np.empty((0, 3))


CLOUDS: dict[str, Callable[[Scene], np.ndarray]] = {
    "other-cloud": other_scene,
    "no-cloud": no_cloud,
}
"""What controls see in place of the scene."""


def learned(robot: Robot, model: str, name: str, choice: SamplerChoice) -> Stages:
    """The stages of a learned sampler; name: what result rows call its distribution.

    InvalidInputError for weights that lack what its predictor needs.
    """
    codebook = codebook_of(model, robot)
    predict: CodePredictor
    observe: Callable[[Scene], np.ndarray] | None = None
    match choice.predictor:
        case "transformer":
            all_beams = choice.sequences == "all-beams"
            predict, observe = (
                partial(transformer_codes, _scene_predictor(model, robot), all_beams),
                observer(),
            )
        case "published":
            predict, observe = partial(published_codes, _predictor(model, robot)), observer()
        case "random":
            predict = partial(random_codes, len(codebook.vectors))
        case _:  # oracle
            predict = partial(oracle_codes, partial(codes_of, model_of(model), robot))
    if observe is not None:
        observe = CLOUDS.get(choice.cloud, observe)
    noise = code_noise(len(codebook.vectors), robot.dof)
    sampler = LearnedSampler(predict, choice, name, codebook, robot, noise)
    updates: dict[str, Callable[[Query, Proposal], Proposal] | None] = {
        "none": None,
        "algorithm-2": partial(
            sampler.moved, LatentOptimizer(codebook, LatentSettings(steps=STEPS))
        ),
        "projected": sampler.projected,
    }
    return Stages(predict=sampler.propose, observe=observe, update=updates[choice.update])


@lru_cache(maxsize=4)
def _scene_predictor(model: str, robot: Robot) -> SceneTransformerPredictor:
    return SceneTransformerPredictor(load_vq_mpt(robot, model), robot)


@lru_cache(maxsize=4)
def _predictor(model: str, robot: Robot) -> Predictor:
    return Predictor(model_of(model), robot)


def mpnet(robot: Robot, model: str, bridged: bool = False) -> Stages:
    """MPNet's rollouts as published; bridged:
    whatever rollouts leave open is joined by tree growth.
    """
    points = model_of(model, MPNET).config.n_points
    return Stages(predict=_rollouts(model, bridged), observe=observer(points))


@lru_cache(maxsize=4)
def _rollouts(model: str, bridged: bool) -> MPNetRollouts:
    return MPNetRollouts(model_of(model, MPNET), bridged)
