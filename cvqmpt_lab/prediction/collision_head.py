"""What the model believes about configurations, from the cloud alone; the mathematics of `models.compact.heads`."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.config import EPSILON, ModelConfig, TransformerConfig
from cvqmpt_lab.models.stored import StoredModel, Tensors
from cvqmpt_lab.prediction.cloud_encoder import PointCloudEncoder, checked_cloud
from cvqmpt_lab.prediction.configurations import ModelConfigurations
from cvqmpt_lab.prediction.layers import Affine, LayerNorm, Perceptron, softmax
from cvqmpt_lab.robot.robot import Robot

LAYERS = 2


@dataclass(frozen=True, eq=False)
class _CrossAttention:
    """Queries look at a context, not at each other, then a feed-forward block; both normalised first."""

    n_heads: int
    norm: LayerNorm
    query: np.ndarray
    key: np.ndarray
    value: np.ndarray
    out: np.ndarray
    first: Affine
    second: Affine
    inner_norm: LayerNorm

    @classmethod
    def of(cls, tensors: Tensors, sizes: TransformerConfig) -> Self:
        d, h, inner = sizes.d_model, sizes.n_heads, sizes.d_inner
        widths = {"w_qs": h * sizes.d_k, "w_ks": h * sizes.d_k, "w_vs": h * sizes.d_v}
        look, ffn = tensors.under("enc_attn"), tensors.under("pos_ffn")
        query, key, value = (look(f"{name}.weight", w, d).T.astype(np.float32) for name, w in widths.items())
        query /= np.sqrt(np.float32(sizes.d_k))
        return cls(
            h,
            LayerNorm.of(look, "layer_norm", d, EPSILON),
            query,
            key,
            value,
            look("fc.weight", d, h * sizes.d_v).T.astype(np.float32),
            Affine.of(ffn, "w_1", d, inner),
            Affine.of(ffn, "w_2", inner, d),
            LayerNorm.of(ffn, "layer_norm", d, EPSILON),
        )

    def __call__(self, x: np.ndarray, context: np.ndarray) -> np.ndarray:
        """Map queries (c, d) that look at tokens (m, d)."""
        tokens = self.norm(context)
        q, k, v = (
            (rows @ weight).reshape(len(rows), self.n_heads, -1).swapaxes(0, 1)
            for rows, weight in ((self.norm(x), self.query), (tokens, self.key), (tokens, self.value))
        )
        heads = softmax(q @ k.swapaxes(1, 2)) @ v
        x = x + heads.swapaxes(0, 1).reshape(len(x), -1) @ self.out
        return x + self.second(np.maximum(self.first(self.inner_norm(x)), 0.0))


class CollisionHead:
    """A model's collision head at work for one robot."""

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Take the weights over.

        Raises
        ------
        InvalidInputError
            When the model has no collision head.
        """
        config: ModelConfig = model.config
        if not config.sequence.collision_head or "sequence_model" not in model.parts:
            raise InvalidInputError(
                "this model has no collision head; train one with sequence.collision_head"
            )
        sizes, clouds = config.sequence.transformer, config.point_cloud
        tensors = model.part("sequence_model")
        head, d = tensors.under("collision"), sizes.d_model
        self._level = config.sequence.head_level
        self._configurations = ModelConfigurations(model, robot)
        self._encoder = PointCloudEncoder(tensors.under("point_cloud_encoder"), clouds)
        width = (clouds.sa1 if self._level == "fine" else clouds.sa2).widths[1]
        self._embed = Perceptron.of(head, "embed", config.configuration_dim, sizes.d_inner, d)
        self._scene = Affine.of(head, "look.scene", width + 3, d)
        self._layers = [_CrossAttention.of(head.under(f"look.layers.{i}"), sizes) for i in range(LAYERS)]
        self._norm, self._out = LayerNorm.of(head, "look.out.0", d), Affine.of(head, "look.out.1", d, 1)

    def free_probability(self, cloud: np.ndarray, configurations: np.ndarray) -> np.ndarray:
        """P(free) (b,) of configurations (b, n) [rad] in the scene of a cloud (m, 3) [m]."""
        scene = self._scene(getattr(self._encoder(checked_cloud(cloud)), self._level).both)
        x = self._embed(self._configurations.of(configurations))
        for layer in self._layers:
            x = layer(x, scene)
        return 1.0 / (1.0 + np.exp(-self._out(self._norm(x))[:, 0]))
