"""Values measured on held-out paths, batch by batch."""

import numpy as np
import torch
from torch import Tensor


class Measures:
    """Means over several batches, and areas under the curve of labelled scores."""

    def __init__(self) -> None:
        self._sums: dict[str, list[float]] = {}
        self._labelled: dict[str, list[tuple[Tensor, Tensor]]] = {}

    def add(self, name: str, total: float, count: float) -> None:
        """Take in a sum over `count` values."""
        earlier = self._sums.setdefault(name, [0.0, 0.0])
        earlier[0] += total
        earlier[1] += count

    def add_labelled(self, name: str, scores: Tensor, labels: Tensor) -> None:
        """Take in scores and what is true of them, any shape."""
        self._labelled.setdefault(name, []).append((scores.cpu().flatten(), labels.cpu().flatten()))

    def values(self) -> dict[str, float | None]:
        """Each mean and area; None where nothing tells it."""
        result: dict[str, float | None] = {n: v / c if c else None for n, (v, c) in self._sums.items()}
        for name, pairs in self._labelled.items():
            scores, labels = (torch.cat(part).numpy() for part in zip(*pairs, strict=True))
            result[name] = area_under_curve(scores, labels)
        return result


def area_under_curve(scores: np.ndarray, labels: np.ndarray) -> float | None:
    """Probability that a true one scores above a false one; None when there are not both."""
    positive = int(labels.sum())
    if positive in (0, len(labels)):
        return None
    _, inverse, counts = np.unique(scores, return_inverse=True, return_counts=True)
    ranks = (counts.cumsum() - 0.5 * (counts - 1))[inverse]  # ties share their mean rank
    wins = ranks[labels].sum() - 0.5 * positive * (positive + 1)
    return float(wins / (positive * (len(labels) - positive)))
