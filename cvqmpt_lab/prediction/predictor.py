"""From a point cloud, a start and goals to a sampling distribution (paper, section on VQ-MPT and eqn. sample_dist)."""

import hashlib
import time
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import torch

from cvqmpt_lab.distributions import GaussianMixture, Uniform
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.checkpoint import Checkpoint
from cvqmpt_lab.models.compact.inference import CompactInference
from cvqmpt_lab.models.compact.sequence_model import CompactScene, CompactSequenceModel
from cvqmpt_lab.models.decoding.beam_search import CodeSequence, beam_search, sample_sequences
from cvqmpt_lab.models.decoding.step_decoder import StepDecoder
from cvqmpt_lab.models.point_cloud.sampling import require_point_cloud
from cvqmpt_lab.models.published.sequence_model import PublishedScene, PublishedSequenceModel
from cvqmpt_lab.prediction.code_decoder import CodeDecoder, Refinement
from cvqmpt_lab.prediction.configurations import ModelConfigurations
from cvqmpt_lab.prediction.prediction import CodeUnion, Prediction
from cvqmpt_lab.prediction.settings import PredictorSettings
from cvqmpt_lab.robot.robot import Robot

GOAL_STD = 0.1
"""Of the Gaussian around each goal, as a share of each joint's range (published code)."""
LIMIT_TOLERANCE = 1e-6
"""Start and goals may leave the joint limits by this much [rad or m]."""
SMALLEST_STD = 1e-4
"""No Gaussian is narrower in any direction [rad], so that its covariance stays positive definite."""


@dataclass(frozen=True, eq=False)
class EncodedScene:
    """A cloud as the model sees it."""

    scene: CompactScene | PublishedScene
    cached: bool
    """Whether it was encoded before."""
    seconds: float
    """What encoding took this time."""


class Predictor:
    """A trained VQ-MPT model at work for one robot, on the CPU."""

    def __init__(
        self, checkpoint: Checkpoint, robot: Robot, settings: PredictorSettings | None = None
    ) -> None:
        """Take a snapshot of the checkpoint's weights; load it with `models.checkpoint.load_checkpoint`.

        Raises
        ------
        InvalidInputError
            When it has no sequence model, belongs to another robot, or its link features do.
        """
        if checkpoint.sequence_model is None:
            raise InvalidInputError("the checkpoint is a dictionary alone; train stage2 for a sequence model")
        self.settings = PredictorSettings() if settings is None else settings
        self.checkpoint, self.robot = checkpoint, robot
        self.configurations = ModelConfigurations(checkpoint, robot)
        self.decoder = CodeDecoder(checkpoint.dictionary)
        self._vectors = checkpoint.dictionary.quantizer.embedding.weight.detach().cpu().numpy().copy()
        self._model = checkpoint.sequence_model
        self._inference: CompactInference | None = None
        if isinstance(self._model, CompactSequenceModel):
            self._inference = CompactInference(self._model, checkpoint.dictionary)
        self._scenes: OrderedDict[str, CompactScene | PublishedScene] = OrderedDict()

    def encode_scene(self, cloud: np.ndarray) -> EncodedScene:
        """Encode a cloud (m, 3) [m, robot base frame], or find it among the latest ones.

        Raises
        ------
        InvalidInputError
            For fewer than two points, another shape, NaN, or an extent that cannot be metres.
        """
        began = time.perf_counter()
        points = _checked_cloud(cloud)
        key = hashlib.sha256(points.tobytes()).hexdigest()
        cached = key in self._scenes
        if cached:
            self._scenes.move_to_end(key)
        else:
            with torch.inference_mode():
                self._scenes[key] = self._model.encode_scene([torch.from_numpy(points)])
            if len(self._scenes) > self.settings.scenes:
                self._scenes.popitem(last=False)
        return EncodedScene(self._scenes[key], cached, time.perf_counter() - began)

    @torch.inference_mode()
    def predict(
        self, cloud: np.ndarray, start: np.ndarray, goals: np.ndarray, rng: np.random.Generator
    ) -> Prediction:
        """Predict code sequences from start (n,) to each of goals (k, n) [rad or m], in one batch.

        `rng` is drawn from when decoding is ``sampled``.

        Raises
        ------
        InvalidInputError
            For a cloud that `encode_scene` refuses, or a start or goal that is no configuration of the robot.
        """
        start, goals = self._checked(start, goals)
        encoded = self.encode_scene(cloud)
        began = time.perf_counter()
        ends = torch.from_numpy(self.configurations.of(np.vstack((start[None], goals))))
        starts, ends = ends[:1].expand(len(goals), -1), ends[1:]
        sequences = self._decode(self._step_decoder(encoded.scene, starts, ends), rng)
        union = CodeUnion.of(sequences, self.settings.repeated_codes)
        refinement = self._refinement(encoded.scene, starts, ends, union)
        z = self._vectors[union.codes]
        gaussians = self.decoder.decode(z, refinement)
        mean, covariance = gaussians.mean.astype(np.float64), gaussians.covariance
        span = self.configurations.range
        return Prediction(
            start=start,
            goals=goals,
            sequences=sequences,
            codes=union.codes,
            goal_of=union.goal_of,
            z=z,
            refinement=refinement,
            mean_u=mean,
            covariance_u=covariance,
            means=self.configurations.radians(mean),
            covariances=covariance * span * span[:, None],
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
        settings, span = self.settings, self.configurations.range
        means, covariances = prediction.means, prediction.covariances
        if z is not None:
            if np.shape(z) != prediction.z.shape:
                raise InvalidInputError(f"codes of shape {np.shape(z)}; expected {prediction.z.shape}")
            gaussians = self.decoder.decode(z, prediction.refinement)
            means = self.configurations.radians(gaussians.mean.astype(np.float64))
            covariances = gaussians.covariance * span * span[:, None]
        covariances = _widened(covariances, max(settings.std_floor or 0.0, SMALLEST_STD))
        if settings.goal_gaussian and not (settings.uniform_without_codes and len(means) == 0):
            goals = prediction.goals
            around = np.broadcast_to(np.diag((GOAL_STD * span) ** 2), (len(goals), len(span), len(span)))
            means, covariances = np.concatenate((means, goals)), np.concatenate((covariances, around))
        uniform = Uniform(self.robot.lower, self.robot.upper)
        return GaussianMixture.equal(means, covariances, uniform, settings.uniform_share, settings.name)

    def _step_decoder(
        self, scene: CompactScene | PublishedScene, starts: torch.Tensor, goals: torch.Tensor
    ) -> StepDecoder:
        if self._inference is not None:
            assert isinstance(scene, CompactScene)
            return self._inference.decoder(scene, starts, goals)
        assert isinstance(self._model, PublishedSequenceModel) and isinstance(scene, PublishedScene)
        return self._model.decoder(self.checkpoint.dictionary, scene, starts, goals)

    def _decode(self, decoder: StepDecoder, rng: np.random.Generator) -> tuple[tuple[CodeSequence, ...], ...]:
        settings = self.settings
        length = settings.max_length or self.checkpoint.config.sequence.max_length
        if settings.decoding == "beam":
            found = beam_search(decoder, beams=settings.beams, max_length=length, scoring=settings.scoring)
            return tuple((one,) for one in found)
        return tuple(
            sample_sequences(
                decoder, settings.sequences, rng, temperature=settings.temperature, max_length=length
            )
        )

    def _refinement(
        self,
        scene: CompactScene | PublishedScene,
        starts: torch.Tensor,
        goals: torch.Tensor,
        union: CodeUnion,
    ) -> Refinement | None:
        """Shift and width of each code's Gaussian at its place in the sequence it is taken from."""
        model = self._model
        if not isinstance(model, CompactSequenceModel) or model.refinement is None:
            return None
        assert isinstance(scene, CompactScene)
        n = self.robot.dof
        if len(union.codes) == 0:
            return Refinement(np.empty((0, n), np.float32), np.empty((0, n), np.float32))
        rows, padded = torch.from_numpy(union.goal_of_sequence), torch.from_numpy(union.padded)
        dictionary = self.checkpoint.dictionary
        end_codes = None
        if model.config.sequence.start_goal_codes:
            both = torch.stack((starts, goals), 1).flatten(0, 1)
            end_codes = dictionary.encode(both[:, None]).view(-1, 2)[rows]
        output = model(scene, starts[rows], goals[rows], padded, end_codes)
        states = output.states[torch.from_numpy(union.sequence), torch.from_numpy(union.place)]
        gaussians = model.refinement(states, torch.zeros(len(states), n))
        return Refinement(gaussians.mean.numpy(), gaussians.diagonal.sqrt().numpy())

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


def _checked_cloud(cloud: np.ndarray) -> np.ndarray:
    """The cloud (m, 3) as contiguous float32."""
    points = np.array(_numbers(cloud, "point cloud"))  # torch wants arrays that may be written to
    if points.ndim != 2:
        raise InvalidInputError(f"point cloud of shape {points.shape}; it must be (n, 3) [m]")
    require_point_cloud(torch.from_numpy(points))
    return np.ascontiguousarray(points, dtype=np.float32)


def _widened(covariances: np.ndarray, std: float) -> np.ndarray:
    """Covariances (c, n, n) without a direction narrower than std."""
    values, vectors = np.linalg.eigh(covariances)
    narrow = values[:, 0] < std * std
    if not narrow.any():
        return covariances
    values, vectors = np.maximum(values[narrow], std * std), vectors[narrow]
    result = covariances.copy()
    result[narrow] = (vectors * values[:, None, :]) @ vectors.swapaxes(1, 2)
    return result
