"""From code vectors to Gaussians and back with the gradient, in numpy.

Same mathematics as `models.Dictionary.decode`. For a few dozen codes a torch call costs several times what
it computes, and the latent optimizer needs many; tests compare values and gradients with torch.
"""

from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.models.config import EPSILON
from cvqmpt_lab.models.stored import StoredModel


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
