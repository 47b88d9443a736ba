"""Predictors of sequences of codes h_1 ... h_n, from a cloud, a start and goals.

    scene = predictor.encode(cloud)
    goals = predictor.by_cost(scene, start, goals)[:3]
    beams = predictor.hypotheses(scene, start, goals)

The scene transformer needs no torch; the authors' network does. Codes are decoded step by step, all
hypotheses of all goals in one batch.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from cvqmpt_lab.base.caches import LruCache
from cvqmpt_lab.base.errors import require_installed
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.sensing.observation import CameraSettings, thinned
from cvqmpt_lab.vqmpt.beam_search import CodeSequence, StepDecoder, beam_search
from cvqmpt_lab.vqmpt.codebook import ModelConfigurations, require_own_dictionary
from cvqmpt_lab.vqmpt.numpy_decoder import SequenceDecoder
from cvqmpt_lab.vqmpt.numpy_encoder import EncodedScene, SceneNetwork, compiled_groups
from cvqmpt_lab.vqmpt.transformer_inputs import Ends
from cvqmpt_lab.vqmpt.weights import StoredModel


class SequencePredictor(ABC):
    """A sequence model with its weights, for one robot."""

    # whether beam search follows the authors' code, and repeated codes of sequences are all used
    published: ClassVar[bool]
    max_length: int  # maximum number of predicted tokens, the goal token included

    def __init__(self, scenes: int = 8) -> None:
        """Prepare a cache of so many encoded scenes."""
        self._scenes = LruCache[Any](scenes)

    def encode(self, cloud: np.ndarray, use_cache: bool = True) -> Any:
        """Encode a cloud (m, 3) [m, robot base frame]; the last encoded scenes are cached."""
        points = np.ascontiguousarray(cloud, dtype=np.float32)
        return self._scenes.get(points.tobytes(), lambda: self._encoded(points), use_cache)

    @abstractmethod
    def _encoded(self, points: np.ndarray) -> Any:
        """Encode points (m, 3) float32 [m]."""

    def by_cost(self, scene: Any, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Sort goals (k, n) by cost; by default by distance to the start (n,)."""
        distances = np.linalg.norm(goals - start, axis=1)
        return goals[np.argsort(distances, kind="stable")]

    @abstractmethod
    def _decoder(self, scene: Any, start: np.ndarray, goals: np.ndarray) -> StepDecoder:
        """Return a decoder from the start (n,) to each of the goals (k, n) in an encoded scene."""

    def hypotheses(
        self,
        scene: Any,
        start: np.ndarray,
        goals: np.ndarray,
        *,
        every: bool = False,
        beams: int = 3,
    ) -> list[list[CodeSequence]]:
        """Find the hypotheses of a beam search for each goal, the likeliest first.

        Args:
            scene: result of `encode`.
            start: (n,) [rad or m].
            goals: (k, n) [rad or m].
            every: continue until all hypotheses are finished, not only the best one.
            beams: K, number of hypotheses for each goal.
        """
        return beam_search(
            self._decoder(scene, start, goals),
            beams=beams,
            max_length=self.max_length,
            every=every,
            published=self.published,
        )


class SceneTransformerPredictor(SequencePredictor):
    """A trained scene transformer."""

    published = False

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Copy the weights; InvalidInputError if robot, dictionary or sizes do not fit."""
        super().__init__()
        self.network = SceneNetwork(model, robot)
        self.max_length = self.network.config.max_codes + 1
        require_own_dictionary(model)

    def _encoded(self, points: np.ndarray, most_points: int = 1024) -> EncodedScene:
        """Encode points; clouds larger than in training are thinned evenly."""
        config = self.network.config
        if len(points) == 0:
            points = np.array([config.empty_cloud_point], dtype=np.float32)
        if len(points) > most_points:
            settings = CameraSettings.like_training(most_points, noise=0.0)
            points = thinned(points, settings, np.random.default_rng(0)).astype(np.float32)
        groups = compiled_groups(points, config.sizes.groups, config.sizes.group_size)
        return self.network.encode(*groups)

    def goal_costs(self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Cost (k,) [rad] of the shortest path over the roadmap from start (n,) to goals (k, n).

        A motion costs length - w log P(free). No sequence is decoded.
        """
        ends = self.network.ends(scene, np.vstack([start[None], goals]))
        start_end = Ends(*(part[:1] for part in ends))
        from_start = self.network.cost_to_go(scene, start_end)[0]
        return (from_start[ends.near[1:]] + ends.cost[1:]).min(axis=1)

    def by_cost(self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Sort goals (k, n) by `goal_costs`, since the path to a near goal may be blocked."""
        return goals[np.argsort(self.goal_costs(scene, start, goals), kind="stable")]

    def _decoder(self, scene: EncodedScene, start: np.ndarray, goals: np.ndarray) -> StepDecoder:
        return SequenceDecoder(self.network, scene, start, goals)


class PublishedPredictor(SequencePredictor):
    """A trained model of the authors' architecture."""

    published = True

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Copy the weights; InvalidInputError if they do not fit the robot or the configuration."""
        super().__init__()
        model.require_part("sequence_model")
        require_installed("torch", "a sequence model of kind 'published'", "train")
        from cvqmpt_lab.vqmpt.checkpoint import as_modules

        self._configurations = ModelConfigurations(model, robot)
        modules = as_modules(model).modules
        self._dictionary, self._network = modules["dictionary"], modules["sequence_model"]
        _, sequence = model.config.stage2
        self.max_length = sequence.max_length

    def _encoded(self, points: np.ndarray) -> Any:
        """Encode points to scene tokens; InvalidInputError if there are fewer than two."""
        return self._network.encode_cloud(points)

    def _decoder(self, scene: Any, start: np.ndarray, goals: np.ndarray) -> StepDecoder:
        ends = self._configurations.normalised(np.vstack((start[None], goals))).astype(np.float32)
        starts = ends[:1].repeat(len(goals), axis=0)
        return self._network.decoder(self._dictionary, scene, starts, ends[1:])
