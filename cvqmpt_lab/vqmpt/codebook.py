"""The dictionary at planning time, in numpy: decoder g(z), its gradient, codes of configurations.

It computes the same as the torch modules of `dictionary`, which are trained; tests compare values
and gradients. Planning uses numpy because Algorithm 2 makes many calls with a few dozen codes each,
for which the overhead of a torch call is several times the computation.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.vqmpt.code_nodes import code_noise, drawn_nodes
from cvqmpt_lab.vqmpt.config import LAYER_NORM_EPSILON, SerialChain
from cvqmpt_lab.vqmpt.weights import (
    TRAINED_BY,
    TRANSFORMER,
    RobotSignature,
    StoredModel,
    robot_signature,
)

DICTIONARY = "dictionary"  # name of this part of a model


@dataclass(frozen=True, eq=False)
class CodeGaussians:
    """Gaussians of codes in normalised joints: u = mu + L D^(1/2) eps, eps ~ N(0, I)."""

    mean: np.ndarray  # (c, n), mu
    scale: np.ndarray  # (c, n, n), L D^(1/2), lower triangular
    saved: tuple[np.ndarray, ...]  # intermediate values for `CodeDecoder.gradient`

    @property
    def covariance(self) -> np.ndarray:
        """Sigma = L D L^T (c, n, n), float64."""
        scale = self.scale.astype(np.float64)
        return scale @ scale.swapaxes(1, 2)


class CodeDecoder:
    """The decoder g(z) = N(mu, Sigma) of a dictionary (paper, eqn. decoder_eqn), Sigma = L D L^T.

        x  = W z + b,                       y = layer norm(x + W_2 relu(W_1 x + b_1) + b_2),
        mu = (tanh(W_mu y + b_mu) + 1) / 2,                D = softplus(W_D y + b_D),
        L  = I + strict lower triangle of (W_L y + b_L).

    For speed, W is multiplied into the following layers, and the mean, scale and shift of the layer
    norm into the layers before and after it.
    """

    def __init__(self, model: StoredModel, dtype: type = np.float32) -> None:
        """Read a model's decoder; InvalidInputError if weights do not fit the configuration."""
        sizes, n = model.config.dictionary, model.config.joint_dim
        d, inner = sizes.transformer.d_model, sizes.transformer.d_inner

        def as_used(array: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(array, dtype=dtype)

        w_out, b_out = model.linear(DICTIONARY, "quantizer.output_linear_map", sizes.code_dim, d)
        w_1, b_1 = model.linear(DICTIONARY, "decoder.pos_ffn.w_1", d, inner)
        w_2, b_2 = model.linear(DICTIONARY, "decoder.pos_ffn.w_2", inner, d)
        gain, offset = (
            model.array(DICTIONARY, f"decoder.pos_ffn.layer_norm.{name}", d)
            for name in ("weight", "bias")
        )
        outputs = {"mu": n, "diag": n, "l": n * (n - 1) // 2}
        heads = [
            model.linear(DICTIONARY, f"decoder.{name}.0", d, size) for name, size in outputs.items()
        ]
        head_w, head_b = (np.concatenate(parts) for parts in zip(*heads, strict=True))
        self.n, self.dtype = n, dtype
        # products of two layers, so that decoding and its gradient take fewer steps
        self._inner = as_used(w_1 @ w_out)
        self._inner_bias = as_used(w_1 @ b_out + b_1)
        self._direct = as_used(w_out - w_out.mean(axis=0))
        self._second = as_used(w_2 - w_2.mean(axis=0))
        bias = b_out + b_2
        self._bias = as_used(bias - bias.mean())
        self._heads = as_used(head_w * gain)
        self._heads_bias = as_used(head_b + head_w @ offset)
        self._rows, self._columns = np.tril_indices(n, -1)

    def decode(self, z: np.ndarray) -> CodeGaussians:
        """Compute the Gaussians g(z) of code vectors z (c, code_dim)."""
        n = self.n
        z = np.asarray(z, dtype=self.dtype)
        hidden = z @ self._inner.T
        hidden += self._inner_bias
        np.maximum(hidden, 0.0, out=hidden)
        y = hidden @ self._second.T
        y += z @ self._direct.T
        y += self._bias
        variance = np.einsum("cd,cd->c", y, y)[:, None] / y.shape[1]
        rate = 1.0 / np.sqrt(variance + self.dtype(LAYER_NORM_EPSILON))
        y *= rate
        heads = y @ self._heads.T
        heads += self._heads_bias
        tanh = np.tanh(heads[:, :n])
        root = np.sqrt(np.logaddexp(0.0, heads[:, n : 2 * n]))  # D^(1/2)
        lower: np.ndarray = np.zeros((len(z), n, n), dtype=self.dtype)
        lower[:, np.arange(n), np.arange(n)] = 1.0
        lower[:, self._rows, self._columns] = heads[:, 2 * n :]
        saved = (hidden, y, rate, tanh, root, lower)
        return CodeGaussians(0.5 * (tanh + 1.0), lower * root[:, None, :], saved)

    def gradient(
        self, gaussians: CodeGaussians, by_mean: np.ndarray, by_scale: np.ndarray
    ) -> np.ndarray:
        """Compute dL/dz = dL/dmu dmu/dz + dL/d(L D^(1/2)) d(L D^(1/2))/dz, by the chain rule.

        Args:
            gaussians: result of `decode` for the codes z.
            by_mean: (c, n), dL/dmu.
            by_scale: (c, n, n), dL/d(L D^(1/2)).

        Returns:
            dL/dz (c, code_dim).
        """
        n = self.n
        by_mean = by_mean.astype(self.dtype, copy=False)
        by_scale = by_scale.astype(self.dtype, copy=False)
        hidden, y, rate, tanh, root, lower = gaussians.saved
        by_heads: np.ndarray = np.zeros((len(y), len(self._heads)), dtype=self.dtype)
        by_heads[:, :n] = 0.5 * by_mean * (1.0 - tanh * tanh)
        by_root = np.einsum("cij,cij->cj", by_scale, lower)
        # d sqrt(softplus(x)) / dx = sigmoid(x) / (2 sqrt(softplus(x))), and
        # sigmoid(x) = 1 - exp(-softplus(x)) with softplus(x) = root^2
        by_heads[:, n : 2 * n] = 0.5 * by_root * -np.expm1(-(root**2)) / np.maximum(root, 1e-12)
        by_heads[:, 2 * n :] = (by_scale * root[:, None, :])[:, self._rows, self._columns]
        by_y = by_heads @ self._heads
        by_y -= y * (np.einsum("cd,cd->c", by_y, y)[:, None] / y.shape[1])
        by_y *= rate
        by_hidden = by_y @ self._second
        by_hidden *= hidden > 0.0
        return by_y @ self._direct + by_hidden @ self._inner


class ModelConfigurations:
    """Inputs of a model for configurations q: joints in [0, 1], and link positions if it has any.

    u = (q - q_min) / (q_max - q_min). The model's metadata names the links and points whose
    positions are inputs; the positions are computed by the robot's kinematics.
    """

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Prepare the inputs; InvalidInputError if robot or features do not fit the model."""
        model.robot.require_same(robot_signature(robot))
        self._robot = robot
        self.lower = robot.lower  # (n,) [rad or m]
        self.range = robot.upper - robot.lower  # (n,) [rad or m]
        self._chain = _feature_chain(model, robot) if model.config.feature_dim else None

    def normalised(self, q: np.ndarray) -> np.ndarray:
        """Scale joints q (..., n) [rad or m] to u (..., n) in [0, 1]."""
        return (q - self.lower) / self.range

    def radians(self, u: np.ndarray) -> np.ndarray:
        """Scale u (..., n) in [0, 1] back to joints q (..., n) [rad or m]."""
        return self.lower + u * self.range

    def of(self, q: np.ndarray) -> np.ndarray:
        """Return inputs (b, n + 3 k) float32 of joints q (b, n): u, and k link positions [m]."""
        parts = [self.normalised(q)]
        if self._chain is not None:
            states = np.ascontiguousarray(q, dtype=float)
            rotation, translation = link_poses(self._robot.kinematics, states)
            links = np.array(self._chain.points) + 1  # pose row 0 is the world
            points = np.einsum("bkij,kj->bki", rotation[:, links], self._chain.offsets)
            parts.append((points + translation[:, links]).reshape(len(q), -1))
        return np.concatenate(parts, axis=1).astype(np.float32)


def _feature_chain(model: StoredModel, robot: Robot) -> SerialChain:
    """Return the serial chain of the model's metadata, whose points are inputs of the model."""
    data = model.metadata.get("kinematics")
    if data is None:
        raise InvalidInputError(
            f"the model takes {model.config.feature_dim} link features, but its metadata has no "
            "kinematics; train it again"
        )
    chain = from_plain(SerialChain, data, "model metadata, kinematics")
    if (len(chain.rotation), chain.feature_dim) != (robot.dof, model.config.feature_dim):
        raise InvalidInputError(
            f"model metadata, kinematics: {len(chain.rotation)} joints and {chain.feature_dim} "
            f"features; the model has {robot.dof} and {model.config.feature_dim}"
        )
    return chain


class Codebook:
    """A dictionary's decoder and code vectors, for one robot."""

    def __init__(self, model: StoredModel, robot: Robot, dtype: type = np.float32) -> None:
        """Read a model's dictionary; errors as in `ModelConfigurations` and `CodeDecoder`."""
        self.configurations = ModelConfigurations(model, robot)
        self.decoder = CodeDecoder(model, dtype)
        self.vectors = code_vectors(model)  # (n_codes, code_dim)

    def gaussians(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Decode codes to Gaussians in radians: q_min + R mu and R Sigma R, R = diag(range).

        Args:
            z: (c, code_dim).

        Returns:
            Means (c, n) [rad] and covariances (c, n, n) [rad^2].
        """
        gaussians = self.decoder.decode(z)
        means = self.configurations.radians(gaussians.mean.astype(np.float64))
        span = self.configurations.range
        return means, gaussians.covariance * np.outer(span, span)


def code_vectors(model: StoredModel) -> np.ndarray:
    """Return the code vectors (n_codes, code_dim) float32, of unit length."""
    sizes = model.config.dictionary
    vectors = model.array(DICTIONARY, "quantizer.embedding.weight", sizes.n_codes, sizes.code_dim)
    if (np.abs(np.linalg.norm(vectors, axis=1) - 1.0) > 1e-4).any():
        raise InvalidInputError(
            "the dictionary has codes that are not of unit length: it was not trained"
        )
    return vectors.astype(np.float32)


def dictionary_gaussians(
    model: StoredModel, robot: Robot | RobotSignature
) -> tuple[np.ndarray, np.ndarray]:
    """Return means (codes, n) [rad] and covariances (codes, n, n) [rad^2] of all codes, float64."""
    lower, span = np.asarray(robot.lower), np.subtract(robot.upper, robot.lower)
    gaussians = CodeDecoder(model, np.float64).decode(code_vectors(model))
    return lower + gaussians.mean * span, gaussians.covariance * np.outer(span, span)


def dictionary_nodes(model: StoredModel, robot: Robot | RobotSignature) -> np.ndarray:
    """Return a configuration for each code (codes, n) [rad], the nodes of the roadmap."""
    means, covariances = dictionary_gaussians(model, robot)
    return drawn_nodes(means, covariances, robot, code_noise(*means.shape))


def codes_of(model: StoredModel, robot: Robot, configurations: np.ndarray) -> np.ndarray:
    """Return the code (b,) int64 of each configuration (b, n) [rad]."""
    if model.config.dictionary.encoder != "mlp":
        raise InvalidInputError(
            f"a dictionary with encoder {model.config.dictionary.encoder!r} encodes whole "
            "trajectories and is only for training; use one with encoder 'mlp', such as vq_mpt"
        )
    return waypoint_codes(model, ModelConfigurations(model, robot).of(configurations))


def waypoint_codes(model: StoredModel, configurations: np.ndarray) -> np.ndarray:
    """Quantise configurations: argmax_i z_i . z, z = W layer norm(perceptron(x)) + b, codes z_i.

    Args:
        model: a model whose encoder takes single waypoints.
        configurations: x (b, configuration_dim).

    Returns:
        Codes (b,) int64.
    """
    sizes = model.config.dictionary
    d, inner = sizes.transformer.d_model, sizes.transformer.d_inner
    widths = pairwise((model.config.configuration_dim, inner, inner, d))
    x = configurations.astype(np.float64)
    for i, (before, after) in enumerate(widths):
        weight, bias = model.linear(DICTIONARY, f"encoder.layers.{2 * i}", before, after)
        if i > 0:  # ReLU between layers
            x = np.maximum(x, 0.0)
        x = x @ weight.T + bias
    gain, offset = (
        model.array(DICTIONARY, f"encoder.layers.5.{name}", d) for name in ("weight", "bias")
    )
    x = x - x.mean(axis=1, keepdims=True)
    x = x / np.sqrt(np.square(x).mean(axis=1, keepdims=True) + LAYER_NORM_EPSILON) * gain + offset
    weight, bias = model.linear(DICTIONARY, "quantizer.input_linear_map", d, sizes.code_dim)
    return ((x @ weight.T + bias) @ code_vectors(model).T).argmax(axis=1)


def require_own_dictionary(model: StoredModel, tolerance: float = 1e-3) -> None:
    """Refuse a transformer that was trained on another dictionary: their nodes are compared.

    Args:
        model: a model with a transformer.
        tolerance: largest difference of a joint of a node [rad or m].

    Raises:
        InvalidInputError: the transformer was trained on another dictionary.
    """
    nodes = dictionary_nodes(model, model.robot)
    trained = model.array(TRANSFORMER, "nodes", *nodes.shape)
    if not np.allclose(nodes, trained, atol=tolerance, rtol=0.0):
        raise InvalidInputError(
            f"transformer was trained on the codes of another dictionary; {TRAINED_BY[TRANSFORMER]}"
        )
