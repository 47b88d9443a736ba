"""Code sequences h_1 ... h_n to each goal, by the authors' sequence model and beam search."""

import hashlib
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from cvqmpt_lab.caches import LruCache
from cvqmpt_lab.errors import InvalidInputError, require_torch
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.vqmpt.beam_search import CodeSequence, beam_search
from cvqmpt_lab.vqmpt.codebook import ModelConfigurations
from cvqmpt_lab.vqmpt.config import checked_cloud
from cvqmpt_lab.vqmpt.weights import StoredModel

SCENES = 8  # encoded clouds in the cache


@dataclass(frozen=True, eq=False)
class Prediction:
    """A code sequence to each of k goals, and the codes of the finished ones."""

    goals: np.ndarray  # (k, n) [rad or m]
    sequences: tuple[CodeSequence, ...]  # to each goal, finished or not
    codes: np.ndarray  # (c,) int64, those of the finished sequences, goal after goal
    encode_seconds: float  # from the cloud to tokens
    predict_seconds: float  # from tokens to codes

    @property
    def unfinished(self) -> tuple[int, ...]:
        """Goals whose sequence did not reach the goal token; they have no codes."""
        return tuple(goal for goal, found in enumerate(self.sequences) if not found.finished)


class Predictor:
    """A trained VQ-MPT model of kind "published", for one robot."""

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Copy a model's weights; InvalidInputError if they do not fit the robot or their sizes."""
        model.require_part("sequence_model")
        require_torch("a sequence model of kind 'published'")
        from cvqmpt_lab.vqmpt.checkpoint import as_modules

        self.robot, self._configurations = robot, ModelConfigurations(model, robot)
        modules = as_modules(model).modules
        self._dictionary, self._network = modules["dictionary"], modules["sequence_model"]
        self._length = model.config.stage2[1].max_length
        self._scenes = LruCache[Any](SCENES)

    def encode_scene(self, cloud: np.ndarray, use_cache: bool = True) -> Any:
        """Tokens of a cloud (m, 3) [m, robot base frame], cached; errors as of `checked_cloud`."""
        points = checked_cloud(cloud)
        key = hashlib.sha256(points.tobytes()).hexdigest()
        return self._scenes.get(key, lambda: self._network.encode_cloud(points), use_cache)

    def predict(
        self, cloud: np.ndarray, start: np.ndarray, goals: np.ndarray, use_cache: bool = True
    ) -> Prediction:
        """Predict a code sequence to each goal, in one batch.

        Args:
            cloud: (m, 3) [m, robot base frame].
            start: (n,) [rad or m].
            goals: (k, n) [rad or m].
            use_cache: for scene tokens.

        Raises InvalidInputError for a cloud that `checked_cloud` refuses, or a start or goal
        outside the joint limits.
        """
        start, goals = checked_ends(self.robot, start, goals)
        began = time.perf_counter()
        scene = self.encode_scene(cloud, use_cache)
        encoded = time.perf_counter()
        ends = self._configurations.normalised(np.vstack((start[None], goals))).astype(np.float32)
        starts, ends = ends[:1].repeat(len(goals), axis=0), ends[1:]
        decoder = self._network.decoder(self._dictionary, scene, starts, ends)
        found = beam_search(decoder, max_length=self._length, published=True)
        sequences = [beam[0] for beam in found]
        each = [found.codes for found in sequences if found.finished]
        return Prediction(
            goals=goals,
            sequences=tuple(sequences),
            codes=np.array([code for codes in each for code in codes], dtype=np.int64),
            encode_seconds=encoded - began,
            predict_seconds=time.perf_counter() - encoded,
        )


def checked_ends(
    robot: Robot, start: np.ndarray, goals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Start (n,) and goals (k, n) [rad or m] as float64; InvalidInputError names a wrong joint."""
    n = robot.dof
    start, goals = _numbers(start, "start"), _numbers(goals, "goals")
    if start.shape != (n,):
        raise InvalidInputError(f"start of shape {start.shape}; the robot takes ({n},)")
    if goals.ndim != 2 or goals.shape[1] != n or len(goals) == 0:
        raise InvalidInputError(
            f"goals of shape {goals.shape}; the robot takes (k, {n}), at least one"
        )
    for what, q in (("start", start), *((f"goal {i}", goal) for i, goal in enumerate(goals))):
        if not np.isfinite(q).all():
            joint = robot.joint_names[int(np.argmin(np.isfinite(q)))]
            raise InvalidInputError(f"{what}: joint {joint!r} is not finite")
        outside = robot.joint_outside_limits(q, 1e-6)  # 1e-6 rad or m for rounding
        if outside is not None:
            raise InvalidInputError(
                f"{what}: joint {outside[0]!r} is {outside[1]:g} outside its limits"
            )
    return start, goals


def _numbers(value: np.ndarray, name: str) -> np.ndarray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{name} must be numbers: {error}") from error
