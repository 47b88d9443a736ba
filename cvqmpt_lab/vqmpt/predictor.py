"""How sequences are decoded and what the mixture is made of: our choices, and the authors'."""

import hashlib
import time
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Self, get_args

import numpy as np

from cvqmpt_lab.distributions import GaussianMixture, Uniform
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError, require_torch
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.vqmpt.beam_search import CodeSequence, Scoring, beam_search
from cvqmpt_lab.vqmpt.codebook import Codebook, widened
from cvqmpt_lab.vqmpt.inputs import checked_cloud
from cvqmpt_lab.vqmpt.weights import StoredModel


@dataclass(frozen=True, kw_only=True)
class PredictorSettings:
    """How sequences are decoded and what the mixture is made of.

    Defaults were chosen on the tuning environments; the authors' are `AS_PUBLISHED`.
    """

    beams: int = 3
    """K of the paper's eqn. prob_eqn."""
    scoring: Scoring = "log-probability"
    """What beams are ranked by, see `beam_search`."""
    max_length: int | None = None
    """Tokens predicted at most, the goal token included; None for the model's own length."""
    goal_gaussian: bool = True
    """Also a Gaussian of 10 % of each joint's range around every goal (published code; the paper has none)."""
    repeated_codes: bool = False
    """A code that a goal's sequences hold several times counts as often in the mixture (published code)."""
    uniform_share: float = 0.5
    """Of samples drawn uniformly between the joint limits; 0 leaves the mixture without a tail."""
    uniform_without_codes: bool = False
    """Sample uniformly when no sequence reaches a goal (published code), else around the goals alone."""
    std_floor: float | None = 0.8
    """Gaussians are widened until no direction is narrower than this [rad]; None to leave them."""
    scenes: int = 8
    """How many encoded clouds are kept."""
    name: str = "cvq-mpt"

    def __post_init__(self) -> None:
        if self.scoring not in get_args(Scoring):
            raise UnknownChoiceError("scoring", self.scoring, get_args(Scoring))
        for name in ("beams", "scenes"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} of the predictor is {getattr(self, name)}; give at least 1")
        if not 0.0 <= self.uniform_share <= 1.0:
            raise InvalidInputError(f"uniform_share of the predictor is {self.uniform_share}; give 0 to 1")
        if self.std_floor is not None and not self.std_floor > 0.0:
            raise InvalidInputError(
                f"std_floor of the predictor is {self.std_floor}; give more than 0 rad, or None"
            )


AS_PUBLISHED = PredictorSettings(
    scoring="published",
    repeated_codes=True,
    uniform_share=0.0,
    uniform_without_codes=True,
    std_floor=None,
    name="cvq-as-published",
)
"""What the authors' code does."""


# What a sequence model predicts for a start and goals: code sequences, their union and its Gaussians.
@dataclass(frozen=True, eq=False)
class Prediction:
    """A code sequence to each of k goals, and the c codes of those that are finished with their Gaussians."""

    goals: np.ndarray
    """(k, n) [rad or m]."""
    sequences: tuple[CodeSequence, ...]
    """To each goal, finished or not."""
    codes: np.ndarray
    """(c,) int64, indices into the dictionary."""
    goal_of: np.ndarray
    """(c,) int64, the goal each code is for."""
    z: np.ndarray
    """(c, code_dim), the codes' vectors of unit length; what the latent optimizer moves."""
    means: np.ndarray
    """(c, n) [rad]."""
    covariances: np.ndarray
    """(c, n, n) [rad^2]."""
    encode_seconds: float
    """From the cloud to tokens."""
    predict_seconds: float
    """From tokens to Gaussians."""
    cached: bool
    """Whether the scene was known."""

    @property
    def unfinished(self) -> tuple[int, ...]:
        """Goals whose sequence did not reach the goal token; they have no codes."""
        return tuple(goal for goal, found in enumerate(self.sequences) if not found.finished)


@dataclass(frozen=True, eq=False)
class CodeUnion:
    """Codes of the finished sequences."""

    codes: np.ndarray
    """(c,) int64."""
    goal_of: np.ndarray
    """(c,) int64, the goal each code is for."""

    @classmethod
    def of(cls, sequences: list[CodeSequence], repeated: bool = False) -> Self:
        """The codes to each goal in order; those that a sequence repeats count once unless `repeated`."""
        of_goal = [
            (one.codes if repeated else tuple(dict.fromkeys(one.codes))) if one.finished else ()
            for one in sequences
        ]
        codes = np.array([code for codes in of_goal for code in codes], dtype=np.int64)
        return cls(codes, np.repeat(np.arange(len(of_goal)), [len(codes) for codes in of_goal]))


# From a point cloud, a start and goals to a sampling distribution (paper, section on VQ-MPT and eqn. sample_dist).
GOAL_STD = 0.1
"""Of the Gaussian around each goal, as a share of each joint's range (published code)."""
LIMIT_TOLERANCE = 1e-6
"""Start and goals may leave the joint limits by this much [rad or m]."""
SMALLEST_STD = 1e-4
"""No Gaussian is narrower in any direction [rad], so that its covariance stays positive definite."""


@dataclass(frozen=True, eq=False)
class EncodedScene:
    """A cloud as the network sees it."""

    scene: Any
    """What the network's `encode_scene` gave."""
    cached: bool
    """Whether it was encoded before."""
    seconds: float
    """What encoding took this time."""


class Predictor:
    """A trained VQ-MPT model of kind "published" at work for one robot, on the CPU."""

    def __init__(self, model: StoredModel, robot: Robot, settings: PredictorSettings | None = None) -> None:
        """Take over a model's weights; `load_vq_mpt` reads them.

        Raises
        ------
        InvalidInputError
            When it has no sequence model, belongs to another robot, or its weights do not fit its configuration.
        """
        model.part("sequence_model")
        require_torch("a sequence model of kind 'published'")
        from cvqmpt_lab.vqmpt.checkpoint import PublishedNetwork

        self.settings = PredictorSettings() if settings is None else settings
        self.robot, self.codebook = robot, Codebook(model, robot)
        self._network = PublishedNetwork(model)
        self._length = self.settings.max_length or model.config.stage2[1].max_length
        self._scenes: OrderedDict[str, Any] = OrderedDict()

    def encode_scene(self, cloud: np.ndarray, anew: bool = False) -> EncodedScene:
        """Encode a cloud (m, 3) [m, robot base frame], or, unless anew, find it among the latest ones.

        Raises
        ------
        InvalidInputError
            For a cloud that `checked_cloud` refuses.
        """
        began = time.perf_counter()
        points = checked_cloud(cloud)
        key = hashlib.sha256(points.tobytes()).hexdigest()
        cached = key in self._scenes and not anew
        if cached:
            self._scenes.move_to_end(key)
        else:
            self._scenes[key] = self._network.encode_scene(points)
            if len(self._scenes) > self.settings.scenes:
                self._scenes.popitem(last=False)
        return EncodedScene(self._scenes[key], cached, time.perf_counter() - began)

    def predict(
        self, cloud: np.ndarray, start: np.ndarray, goals: np.ndarray, anew: bool = False
    ) -> Prediction:
        """Predict code sequences from start (n,) to each of goals (k, n) [rad or m], in one batch.

        anew: see `encode_scene`.

        Raises
        ------
        InvalidInputError
            For a cloud that `encode_scene` refuses, or a start or goal that is no configuration of the robot.
        """
        start, goals = self._checked(start, goals)
        encoded = self.encode_scene(cloud, anew)
        began = time.perf_counter()
        settings = self.settings
        ends = self.codebook.configurations.of(np.vstack((start[None], goals)))
        starts, ends = ends[:1].repeat(len(goals), axis=0), ends[1:]
        sequences = beam_search(
            self._network.decoder(encoded.scene, starts, ends),
            beams=settings.beams,
            max_length=self._length,
            scoring=settings.scoring,
        )
        union = CodeUnion.of(sequences, settings.repeated_codes)
        z = self.codebook.vectors[union.codes]
        means, covariances = self.codebook.gaussians(z)
        return Prediction(
            goals=goals,
            sequences=tuple(sequences),
            codes=union.codes,
            goal_of=union.goal_of,
            z=z,
            means=means,
            covariances=covariances,
            encode_seconds=encoded.seconds,
            predict_seconds=time.perf_counter() - began,
            cached=encoded.cached,
        )

    def mixture(self, prediction: Prediction, z: np.ndarray | None = None) -> GaussianMixture | Uniform:
        """The distribution to sample from, all Gaussians equally likely; uniform when there is none.

        Goals that no sequence reached bring no Gaussian but their own.

        Parameters
        ----------
        z
            (c, code_dim): the prediction's codes after optimization; None to leave them.
        """
        settings, span = self.settings, self.codebook.configurations.range
        means, covariances = prediction.means, prediction.covariances
        if z is not None:
            if np.shape(z) != prediction.z.shape:
                raise InvalidInputError(f"codes of shape {np.shape(z)}; expected {prediction.z.shape}")
            means, covariances = self.codebook.gaussians(z)
        covariances = widened(covariances, max(settings.std_floor or 0.0, SMALLEST_STD))
        if settings.goal_gaussian and not (settings.uniform_without_codes and len(means) == 0):
            goals = prediction.goals
            around = np.broadcast_to(np.diag((GOAL_STD * span) ** 2), (len(goals), len(span), len(span)))
            means, covariances = np.concatenate((means, goals)), np.concatenate((covariances, around))
        uniform = Uniform(self.robot.lower, self.robot.upper)
        return GaussianMixture.equal(means, covariances, uniform, settings.uniform_share, settings.name)

    def _checked(self, start: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Start (n,) and goals (k, n) as float64."""
        n = self.robot.dof
        start = _numbers(start, "start")
        goals = _numbers(goals, "goals")
        if start.shape != (n,):
            raise InvalidInputError(f"start of shape {start.shape}; robot {self.robot.name!r} takes ({n},)")
        if goals.ndim != 2 or goals.shape[1] != n or len(goals) == 0:
            raise InvalidInputError(
                f"goals of shape {goals.shape}; robot {self.robot.name!r} takes (k, {n}), at least one"
            )
        for name, q in (("start", start), *((f"goal {i}", goal) for i, goal in enumerate(goals))):
            if not np.isfinite(q).all():
                joint = self.robot.joint_names[int(np.argmin(np.isfinite(q)))]
                raise InvalidInputError(f"{name}: joint {joint!r} is not finite")
            outside = self.robot.joint_outside_limits(q, LIMIT_TOLERANCE)
            if outside is not None:
                raise InvalidInputError(f"{name}: joint {outside[0]!r} is {outside[1]:g} outside its limits")
        return start, goals


def _numbers(value: np.ndarray, name: str) -> np.ndarray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{name} must be numbers: {error}") from error
