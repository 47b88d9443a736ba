"""Weights of the small networks that planning asks in compiled code."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.search import small_network as kernels


@dataclass(frozen=True, eq=False)
class SmallNetwork:
    """Two hidden layers and one answer, as `training.small_network` trains them."""

    first: np.ndarray
    """(h, i)."""
    first_bias: np.ndarray
    """(h,)."""
    second: np.ndarray
    """(k, h)."""
    second_bias: np.ndarray
    """(k,)."""
    last: np.ndarray
    """(k,)."""
    last_bias: np.ndarray
    """(1,)."""

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> "SmallNetwork":
        """From weights by name; InvalidInputError where one is missing or does not fit the others."""
        missing = cls.__annotations__.keys() - arrays.keys()
        if missing:
            raise InvalidInputError(f"weights of a small network without {', '.join(sorted(missing))}")
        network = cls(
            **{name: np.ascontiguousarray(arrays[name], dtype=float) for name in cls.__annotations__}
        )
        h, k = len(network.first_bias), len(network.second_bias)
        shapes = [value.shape for value in vars(network).values()]
        if shapes != [(h, network.first.shape[-1]), (h,), (k, h), (k,), (k,), (1,)]:
            raise InvalidInputError(
                f"weights of a small network have shapes {shapes}, which do not fit each other"
            )
        return network

    @classmethod
    def untrained(cls, inputs: int) -> "SmallNetwork":
        """One that answers 0 to everything."""
        return cls(
            np.zeros((1, inputs)), np.zeros(1), np.zeros((1, 1)), np.zeros(1), np.zeros(1), np.zeros(1)
        )

    @property
    def inputs(self) -> int:
        """How many numbers it reads."""
        return self.first.shape[1]

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Answers (b,) to many questions (b, i) at once."""
        hidden = np.maximum(features @ self.first.T + self.first_bias, 0.0)
        hidden = np.maximum(hidden @ self.second.T + self.second_bias, 0.0)
        return hidden @ self.last + self.last_bias

    def arrays(self) -> kernels.SmallNetwork:
        """For kernels, with work arrays of its own."""
        own = {**vars(self), "last_bias": float(self.last_bias[0])}
        return kernels.SmallNetwork(
            **own, features=np.empty(self.inputs), hidden=np.empty(len(self.first_bias))
        )
