"""Configurations as the models take them: normalised joints u in [0, 1], then link positions, if any."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from cvqmpt_lab.codec.plain import from_plain
from cvqmpt_lab.errors import InvalidInputError, require_torch
from cvqmpt_lab.kernels.manifold.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.vqmpt.config import EPSILON
from cvqmpt_lab.vqmpt.inputs import SerialChain
from cvqmpt_lab.vqmpt.mpnet_numpy import Affine, Perceptron, normalised
from cvqmpt_lab.vqmpt.weights import VQ_MPT, RobotSignature, StoredModel, read_model, resolve_model

CHAIN_TOLERANCE = 1e-4
"""Link frames that differ by less are those that the model was trained with [m, entries of rotations]."""


def robot_signature(robot: Robot) -> RobotSignature:
    """What weights are compared with."""
    limits = tuple(robot.lower.tolist()), tuple(robot.upper.tolist())
    return RobotSignature(robot.name, *limits, tuple(robot.joint_names), robot.kinematics_digest)


class ModelConfigurations:
    """Joints of a robot to what a model takes, and back.

    Which points of which links are features is read from the model's metadata, where training put
    them; where they are comes from the robot's own kinematics.
    """

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Prepare.

        Raises
        ------
        InvalidInputError
            When the model belongs to another robot, or its features were made with other kinematics
            or are not described.
        """
        model.robot.require_same(robot_signature(robot))
        self._robot = robot
        self.lower, self.range = robot.lower, robot.upper - robot.lower
        self._links = np.empty(0, dtype=np.int64)
        self._offsets = np.empty((0, 3))
        if model.config.feature_dim:
            chain = _chain(model, robot)
            self._links = np.array(chain.points) + 1  # pose row 0 is the world
            self._offsets = chain.offsets

    def normalised(self, q: np.ndarray) -> np.ndarray:
        """Joints u (..., n) in [0, 1] of q (..., n) [rad or m]."""
        return (q - self.lower) / self.range

    def radians(self, u: np.ndarray) -> np.ndarray:
        """Joints q (..., n) [rad or m] of u (..., n)."""
        return self.lower + u * self.range

    def of(self, q: np.ndarray) -> np.ndarray:
        """Configurations (b, n + 3 k) float32 of joints q (b, n): u, then positions of k points [m]."""
        parts = [self.normalised(q)]
        if len(self._links):
            rotation, translation = link_poses(self._robot.kinematics, np.ascontiguousarray(q, dtype=float))
            points = np.einsum("bkij,kj->bki", rotation[:, self._links], self._offsets)
            parts.append((points + translation[:, self._links]).reshape(len(q), -1))
        return np.concatenate(parts, axis=1).astype(np.float32)


def _chain(model: StoredModel, robot: Robot) -> SerialChain:
    """The chain whose points are features, which must be the robot's."""
    data = model.metadata.get("kinematics")
    if data is None:
        raise InvalidInputError(
            f"the model takes {model.config.feature_dim} link features, but its metadata has no kinematics; "
            "train it again"
        )
    chain = from_plain(SerialChain, data, "model metadata, kinematics")
    if (len(chain.rotation), chain.feature_dim) != (robot.dof, model.config.feature_dim):
        raise InvalidInputError(
            f"model metadata, kinematics: {len(chain.rotation)} joints and {chain.feature_dim} features; the model "
            f"has {robot.dof} and {model.config.feature_dim}"
        )
    kinematics = robot.kinematics
    if not np.array_equal(kinematics.parent, np.arange(robot.dof)):
        raise InvalidInputError(f"link features are those of a chain, which robot {robot.name!r} is not")
    if chain.sliders != tuple(np.flatnonzero(kinematics.prismatic).tolist()):
        raise InvalidInputError(
            f"the model's link features were made with sliders {list(chain.sliders)}, not those of {robot.name!r}"
        )
    for name in ("rotation", "translation"):
        difference = np.abs(getattr(chain, name) - getattr(kinematics, name))
        difference = difference.reshape(robot.dof, -1).max(axis=1)
        if difference.max() > CHAIN_TOLERANCE:
            joint = int(difference.argmax())
            raise InvalidInputError(
                f"the model's link features were made with another {name} of joint {robot.joint_names[joint]!r} "
                f"(difference {difference[joint]:g}); use the robot description it was trained with"
            )
    return chain


# From code vectors to Gaussians and back with the gradient, in numpy.
@dataclass(frozen=True, eq=False)
class CodeGaussians:
    """Gaussians of codes: u = mean + scale @ eps."""

    mean: np.ndarray
    """(c, n), normalised joints."""
    scale: np.ndarray
    """(c, n, n), lower triangular."""
    _decoder: "CodeDecoder" = field(repr=False)
    _lower: np.ndarray = field(repr=False)
    _root: np.ndarray = field(repr=False)
    _tape: tuple[np.ndarray, ...] = field(repr=False)

    @property
    def covariance(self) -> np.ndarray:
        """(c, n, n), normalised joints, float64."""
        scale = self.scale.astype(np.float64)
        return scale @ scale.swapaxes(1, 2)

    def pull_back(self, mean: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """Gradient by z (c, code_dim) from the gradients by mean (c, n) and scale (c, n, n)."""
        return self._decoder.gradient(self, mean, scale)


class CodeDecoder:
    """A dictionary's decoder.

    The map from codes to the decoder's width is folded into what follows it, the layer norm's centring,
    scale and shift into what stands around it.
    """

    def __init__(self, model: StoredModel, dtype: type = np.float32) -> None:
        sizes, n, tensors = model.config.dictionary, model.config.joint_dim, model.part("dictionary")
        d, inner, z = sizes.transformer.d_model, sizes.transformer.d_inner, sizes.code_dim

        def weights(name: str, before: int, after: int) -> tuple[np.ndarray, np.ndarray]:
            return tensors(f"{name}.weight", after, before), tensors(f"{name}.bias", after)

        def as_used(array: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(array, dtype=dtype)

        w_out, b_out = weights("quantizer.output_linear_map", z, d)
        w_1, b_1 = weights("decoder.pos_ffn.w_1", d, inner)
        w_2, b_2 = weights("decoder.pos_ffn.w_2", inner, d)
        gain, offset = (tensors(f"decoder.pos_ffn.layer_norm.{name}", d) for name in ("weight", "bias"))
        below = n * (n - 1) // 2
        heads = [
            weights(f"decoder.{name}.0", d, size) for name, size in (("mu", n), ("diag", n), ("l", below))
        ]
        head_w, head_b = (np.concatenate(parts) for parts in zip(*heads, strict=True))
        self.n = n
        self.dtype = dtype
        self._inner, self._inner_bias = as_used(w_1 @ w_out), as_used(w_1 @ b_out + b_1)
        self._direct = as_used(w_out - w_out.mean(axis=0))
        self._second = as_used(w_2 - w_2.mean(axis=0))
        bias = b_out + b_2
        self._bias = as_used(bias - bias.mean())
        self._heads, self._heads_bias = as_used(head_w * gain), as_used(head_b + head_w @ offset)
        self._rows, self._columns = np.tril_indices(n, -1)

    def decode(self, z: np.ndarray) -> CodeGaussians:
        """Gaussians of code vectors z (c, code_dim)."""
        n = self.n
        z = np.asarray(z, dtype=self.dtype)
        hidden = z @ self._inner.T
        hidden += self._inner_bias
        np.maximum(hidden, 0.0, out=hidden)
        y = hidden @ self._second.T
        y += z @ self._direct.T
        y += self._bias
        rate = 1.0 / np.sqrt(np.einsum("cd,cd->c", y, y)[:, None] / y.shape[1] + self.dtype(EPSILON))
        y *= rate
        heads = y @ self._heads.T
        heads += self._heads_bias
        tanh = np.tanh(heads[:, :n])
        mean = 0.5 * (tanh + 1.0)
        root = np.sqrt(np.logaddexp(0.0, heads[:, n : 2 * n]))
        tape = (hidden, y, rate, heads, tanh)
        lower: np.ndarray = np.zeros((len(z), n, n), dtype=self.dtype)
        lower[:, np.arange(n), np.arange(n)] = 1.0
        lower[:, self._rows, self._columns] = heads[:, 2 * n :]
        return CodeGaussians(mean, lower * root[:, None, :], self, lower, root, tape)

    def gradient(self, gaussians: CodeGaussians, mean: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """What `CodeGaussians.pull_back` returns."""
        n = self.n
        mean, scale = mean.astype(self.dtype, copy=False), scale.astype(self.dtype, copy=False)
        hidden, y, rate, heads, tanh = gaussians._tape
        by_heads = np.zeros_like(heads)
        by_heads[:, :n] = 0.5 * mean * (1.0 - tanh * tanh)
        by_root = np.einsum("cij,cij->cj", scale, gaussians._lower)
        # d sqrt(softplus(x)) / dx = sigmoid(x) / (2 sqrt(softplus(x))), sigmoid(x) = 1 - exp(-softplus(x))
        by_heads[:, n : 2 * n] = (
            0.5 * by_root * -np.expm1(-(gaussians._root**2)) / np.maximum(gaussians._root, 1e-12)
        )
        by_lower = scale * gaussians._root[:, None, :]
        by_heads[:, 2 * n :] = by_lower[:, self._rows, self._columns]
        by_y = by_heads @ self._heads
        by_y -= y * (np.einsum("cd,cd->c", by_y, y)[:, None] / y.shape[1])
        by_y *= rate
        by_hidden = by_y @ self._second
        by_hidden *= hidden > 0.0
        return by_y @ self._direct + by_hidden @ self._inner


# From configurations to the dictionary's codes, in numpy: the mathematics of `vqmpt.dictionary`.
def code_vectors(model: StoredModel) -> np.ndarray:
    """The codes (n_codes, code_dim) float32, of unit length."""
    sizes = model.config.dictionary
    vectors = model.part("dictionary")("quantizer.embedding.weight", sizes.n_codes, sizes.code_dim)
    if (np.abs(np.linalg.norm(vectors, axis=1) - 1.0) > 1e-4).any():
        raise InvalidInputError("the dictionary has codes that are not of unit length: it was not trained")
    return vectors.astype(np.float32)


@dataclass(frozen=True, eq=False)
class CodeEncoder:
    """Codes of single configurations."""

    perceptron: Perceptron
    project: Affine
    """Onto the space of codes; scale and shift of the norm before it are folded in."""
    vectors: np.ndarray

    @classmethod
    def of(cls, model: StoredModel) -> Self:
        """That of a dictionary whose encoder looks at one waypoint alone.

        Raises
        ------
        InvalidInputError
            For one that looks at whole trajectories.
        """
        sizes = model.config.dictionary
        if sizes.encoder != "mlp":
            raise InvalidInputError(
                f"dictionary.encoder {sizes.encoder!r} looks at whole trajectories; codes of single "
                "configurations need one trained with 'mlp'"
            )
        d, inner = sizes.transformer.d_model, sizes.transformer.d_inner
        tensors = model.part("dictionary")
        return cls(
            Perceptron.of(tensors, "encoder.layers", model.config.configuration_dim, inner, inner, d),
            Affine.of(tensors, "quantizer.input_linear_map", d, sizes.code_dim, norm="encoder.layers.5"),
            code_vectors(model),
        )

    def __call__(self, configurations: np.ndarray) -> np.ndarray:
        """Code (b,) int64 of each configuration (b, configuration_dim): the one of the largest cosine."""
        z = self.project(normalised(self.perceptron(configurations), EPSILON))
        return (z @ self.vectors.T).argmax(axis=1)


# A dictionary's codes as Gaussians over configurations, in radians, and the codes of given configurations.
class Codebook:
    """Decoder and code vectors of a model, for one robot."""

    def __init__(self, model: StoredModel, robot: Robot, dtype: type = np.float32) -> None:
        """Take over a model's dictionary; errors as `ModelConfigurations` and `CodeDecoder` raise them."""
        self.configurations = ModelConfigurations(model, robot)
        self.decoder, self.vectors = CodeDecoder(model, dtype), code_vectors(model)

    def gaussians(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means (c, n) [rad] and covariances (c, n, n) [rad^2] of codes z (c, code_dim)."""
        gaussians, of = self.decoder.decode(z), self.configurations
        covariances = gaussians.covariance * np.outer(of.range, of.range)
        return of.radians(gaussians.mean.astype(np.float64)), covariances


def load_vq_mpt(robot: Robot, model: str | Path | None = None) -> StoredModel:
    """VQ-MPT for a robot; `model` and errors as in `resolve_model`, and those of `read_model`."""
    signature = robot_signature(robot)
    return read_model(resolve_model(model, VQ_MPT, signature), signature, VQ_MPT)


def dictionary_gaussians(model: StoredModel, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Means (codes, n) [rad] and covariances (codes, n, n) [rad^2] of every code, in double precision."""
    codebook = Codebook(model, robot, np.float64)
    return codebook.gaussians(codebook.vectors)


def codes_of(model: StoredModel, robot: Robot, configurations: np.ndarray) -> np.ndarray:
    """Code (b,) int64 of each configuration (b, n) [rad] of one path."""
    given = ModelConfigurations(model, robot).of(configurations)
    if model.config.dictionary.encoder == "mlp":
        return CodeEncoder.of(model)(given)
    require_torch("a dictionary whose encoder looks at whole trajectories")
    from cvqmpt_lab.vqmpt.checkpoint import trajectory_codes

    return trajectory_codes(model, given)


def drawn_nodes(means: np.ndarray, covariances: np.ndarray, robot: Robot, noise: np.ndarray) -> np.ndarray:
    """One configuration (codes, n) from each code's Gaussian, inside the limits; noise (codes, n): standard normal.

    Means crowd in the middle of where paths pass; draws cover it as training's waypoints do.
    """
    draws = means + np.einsum("kij,kj->ki", np.linalg.cholesky(covariances), noise)
    return np.clip(draws, robot.lower, robot.upper)


def widened(covariances: np.ndarray, std: float) -> np.ndarray:
    """Covariances (c, n, n) without a direction narrower than std."""
    values, vectors = np.linalg.eigh(covariances)
    narrow = values[:, 0] < std * std
    if not narrow.any():
        return covariances
    values, vectors = np.maximum(values[narrow], std * std), vectors[narrow]
    result = covariances.copy()
    result[narrow] = (vectors * values[:, None, :]) @ vectors.swapaxes(1, 2)
    return result
