"""From configurations to the dictionary's codes, in numpy: the mathematics of `models.dictionary`."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.config import EPSILON
from cvqmpt_lab.models.stored import StoredModel
from cvqmpt_lab.prediction.layers import Affine, Perceptron, normalised


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
