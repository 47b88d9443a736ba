"""From a point cloud, start and goals to a sampling distribution: both stages of VQ-MPT at work, on the CPU.

Stage 2 predicts to each goal a sequence of codes h_1 ... h_n, found by beam search; stage 1 decodes each code to a
Gaussian. Sampled from is their mixture with equal weights (paper, eqn. sample_dist),

    P(q) = sum_i 1/n g(z_(h_i)),    g(z) = N(mu, Sigma),

to which a Gaussian around every goal and a uniform share are added.
"""

import hashlib
import time
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np

from cvqmpt_lab.errors import InvalidInputError, require_torch
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.search.query import GaussianMixture, Uniform, widened
from cvqmpt_lab.vqmpt.beam_search import CodeSequence, beam_search
from cvqmpt_lab.vqmpt.codebook import Codebook
from cvqmpt_lab.vqmpt.config import checked_cloud
from cvqmpt_lab.vqmpt.weights import StoredModel

GOAL_STD = 0.1  # of the Gaussian around each goal, as a share of each joint's range (published code)
LIMIT_TOLERANCE = 1e-6  # start and goals may leave the joint limits by this much [rad or m]
SMALLEST_STD = 1e-4  # [rad] in any direction, so that covariances stay positive definite
SCENES = 8  # encoded clouds in the cache


@dataclass(frozen=True, kw_only=True)
class PredictorSettings:
    """How sequences are searched and what the mixture is made of; defaults chosen on the tuning environments."""

    published: bool = False
    """As the authors' code: see `beam_search`; repeated codes count; uniform when no sequence reaches a goal."""
    uniform_share: float = 0.5  # of samples drawn between the joint limits; 0: no tail
    std_floor: float | None = 0.8  # Gaussians are widened until no direction is narrower [rad]; None: not
    name: str = "cvq-mpt"

    def __post_init__(self) -> None:
        if not 0.0 <= self.uniform_share <= 1.0:
            raise InvalidInputError(f"uniform_share of the predictor is {self.uniform_share}; give 0 to 1")
        if self.std_floor is not None and not self.std_floor > 0.0:
            raise InvalidInputError(
                f"std_floor of the predictor is {self.std_floor}; give more than 0 rad, or None"
            )


AS_PUBLISHED = PredictorSettings(published=True, uniform_share=0.0, std_floor=None, name="cvq-as-published")


@dataclass(frozen=True, eq=False)
class Prediction:
    """A code sequence to each of k goals, and the c codes of the finished ones with their Gaussians."""

    goals: np.ndarray  # (k, n) [rad or m]
    sequences: tuple[CodeSequence, ...]  # to each goal, finished or not
    codes: np.ndarray  # (c,) int64, those of the finished sequences, goal after goal
    z: np.ndarray  # (c, code_dim), the codes' vectors of unit length; what Algorithm 2 moves
    means: np.ndarray  # (c, n) [rad]
    covariances: np.ndarray  # (c, n, n) [rad^2]
    encode_seconds: float  # from the cloud to tokens
    predict_seconds: float  # from tokens to Gaussians

    @property
    def unfinished(self) -> tuple[int, ...]:
        """Goals whose sequence did not reach the goal token; they have no codes."""
        return tuple(goal for goal, found in enumerate(self.sequences) if not found.finished)


class Predictor:
    """A trained VQ-MPT model of kind "published", for one robot."""

    def __init__(self, model: StoredModel, robot: Robot, settings: PredictorSettings | None = None) -> None:
        """Take over a model's weights.

        Raises InvalidInputError when it has no sequence model, belongs to another robot, or does not fit its sizes.
        """
        model.require_part("sequence_model")
        require_torch("a sequence model of kind 'published'")
        from cvqmpt_lab.vqmpt.checkpoint import as_modules

        self.settings = PredictorSettings() if settings is None else settings
        self.robot, self.codebook = robot, Codebook(model, robot)
        checkpoint = as_modules(model)
        assert checkpoint.sequence_model is not None
        self._dictionary, self._network = checkpoint.dictionary, checkpoint.sequence_model
        self._length = model.config.stage2[1].max_length
        self._scenes: OrderedDict[str, Any] = OrderedDict()

    def encode_scene(self, cloud: np.ndarray, use_cache: bool = True) -> Any:
        """Scene tokens of a cloud (m, 3) [m, robot base frame], found among the latest ones where they are.

        Raises InvalidInputError for a cloud that `checked_cloud` refuses.
        """
        points = checked_cloud(cloud)
        key = hashlib.sha256(points.tobytes()).hexdigest()
        if use_cache and key in self._scenes:
            self._scenes.move_to_end(key)
        else:
            self._scenes[key] = self._network.encode_cloud(points)
            if len(self._scenes) > SCENES:
                self._scenes.popitem(last=False)
        return self._scenes[key]

    def predict(
        self, cloud: np.ndarray, start: np.ndarray, goals: np.ndarray, use_cache: bool = True
    ) -> Prediction:
        """Predict code sequences from start (n,) to each of goals (k, n) [rad or m], in one batch.

        Raises InvalidInputError for a cloud that `checked_cloud` refuses, or a start or goal outside the joint limits.
        """
        start, goals = checked_ends(self.robot, start, goals)
        began = time.perf_counter()
        scene = self.encode_scene(cloud, use_cache)
        encoded = time.perf_counter()
        ends = self.codebook.configurations.of(np.vstack((start[None], goals)))
        starts, ends = ends[:1].repeat(len(goals), axis=0), ends[1:]
        decoder = self._network.decoder(self._dictionary, scene, starts, ends)
        published = self.settings.published
        sequences = beam_search(decoder, max_length=self._length, published=published)
        codes = union(sequences, repeated=published)
        z = self.codebook.vectors[codes]
        means, covariances = self.codebook.gaussians(z)
        return Prediction(
            goals=goals,
            sequences=tuple(sequences),
            codes=codes,
            z=z,
            means=means,
            covariances=covariances,
            encode_seconds=encoded - began,
            predict_seconds=time.perf_counter() - encoded,
        )

    def mixture(self, prediction: Prediction, z: np.ndarray | None = None) -> GaussianMixture | Uniform:
        """The distribution to sample from, all Gaussians equally likely; uniform when there is none.

        z (c, code_dim): the prediction's codes after Algorithm 2; None to leave them.
        """
        settings, span = self.settings, self.codebook.configurations.range
        means, covariances = prediction.means, prediction.covariances
        if z is not None:
            if np.shape(z) != prediction.z.shape:
                raise InvalidInputError(f"codes of shape {np.shape(z)}; expected {prediction.z.shape}")
            means, covariances = self.codebook.gaussians(z)
        covariances = widened(covariances, max(settings.std_floor or 0.0, SMALLEST_STD))
        if len(means) or not settings.published:
            goals = prediction.goals
            around = np.broadcast_to(np.diag((GOAL_STD * span) ** 2), (len(goals), len(span), len(span)))
            means, covariances = np.concatenate((means, goals)), np.concatenate((covariances, around))
        uniform = Uniform(self.robot.lower, self.robot.upper)
        return GaussianMixture.equal(means, covariances, uniform, settings.uniform_share, settings.name)


def checked_ends(robot: Robot, start: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Start (n,) and goals (k, n) as float64; InvalidInputError where they are not within a robot's limits."""
    n = robot.dof
    start, goals = _numbers(start, "start"), _numbers(goals, "goals")
    if start.shape != (n,):
        raise InvalidInputError(f"start of shape {start.shape}; the robot takes ({n},)")
    if goals.ndim != 2 or goals.shape[1] != n or len(goals) == 0:
        raise InvalidInputError(f"goals of shape {goals.shape}; the robot takes (k, {n}), at least one")
    for what, q in (("start", start), *((f"goal {i}", goal) for i, goal in enumerate(goals))):
        if not np.isfinite(q).all():
            joint = robot.joint_names[int(np.argmin(np.isfinite(q)))]
            raise InvalidInputError(f"{what}: joint {joint!r} is not finite")
        outside = robot.joint_outside_limits(q, LIMIT_TOLERANCE)
        if outside is not None:
            raise InvalidInputError(f"{what}: joint {outside[0]!r} is {outside[1]:g} outside its limits")
    return start, goals


def union(sequences: list[CodeSequence], repeated: bool = False) -> np.ndarray:
    """Codes (c,) int64 of the finished sequences; those that a sequence repeats count once unless `repeated`."""
    each = [
        found.codes if repeated else tuple(dict.fromkeys(found.codes))
        for found in sequences
        if found.finished
    ]
    return np.array([code for codes in each for code in codes], dtype=np.int64)


def _numbers(value: np.ndarray, name: str) -> np.ndarray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{name} must be numbers: {error}") from error
