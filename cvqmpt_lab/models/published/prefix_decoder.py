"""Decoding with a model that keeps nothing between two codes."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor


class PrefixDecoder:
    """A `decoding.StepDecoder` that keeps nothing and runs the model on whole prefixes."""

    def __init__(self, queries: Tensor, logits_of: Callable[[Tensor, Tensor], Tensor]) -> None:
        """Decode for queries (q,), their indices.

        `logits_of` maps query indices (rows,) and prefixes (rows, t) to logits (rows, n_classes).
        """
        self._queries = queries
        self._codes = queries.new_zeros(len(queries), 0)
        self._logits_of = logits_of

    def start(self) -> np.ndarray:
        """Logits (queries, n_classes) of the first code."""
        return self._logits()

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """Replace the rows; see `decoding.StepDecoder`."""
        rows, added = (torch.from_numpy(given).to(self._queries.device) for given in (parents, codes))
        self._queries, self._codes = (
            self._queries[rows],
            torch.cat((self._codes[rows], added[:, None]), dim=1),
        )
        return self._logits()

    @torch.inference_mode()
    def _logits(self) -> np.ndarray:
        return self._logits_of(self._queries, self._codes).float().cpu().numpy()
