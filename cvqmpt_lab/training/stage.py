"""A training stage: parameters with their optimizer, batches, losses and validation."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from cvqmpt_lab.training.dataset import TrainingData
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import Dropout, NotNegative, Positive, Share


@dataclass(frozen=True, kw_only=True)
class OptimizerSettings:
    """Adam or Adagrad with a learning rate schedule: warm-up, then decay."""

    kind: Literal["adam", "adagrad"] = "adam"
    rate: Positive  # peak of the learning rate, after the warm-up
    warmup: int = 200  # steps of the linear warm-up
    # decay by the inverse square root of the step (published), by a cosine, or none
    schedule: Literal["inverse-sqrt", "cosine", "constant"] = "inverse-sqrt"
    final: Share = 0.02  # last rate of a cosine, as share of the peak
    betas: tuple[Dropout, Dropout] = (0.9, 0.98)
    epsilon: Positive = 1e-9
    weight_decay: NotNegative = 0.0
    clip: Positive | None = None  # maximum norm of the gradient; None for no limit

    def build(self, module: nn.Module) -> torch.optim.Optimizer:
        """Make the optimizer of a module's parameters."""
        if self.kind == "adagrad":
            return torch.optim.Adagrad(module.parameters(), lr=self.rate)
        return torch.optim.AdamW(
            module.parameters(),
            lr=self.rate,
            betas=self.betas,
            eps=self.epsilon,
            weight_decay=self.weight_decay,
        )

    def rate_at(self, step: int, total: int) -> float:
        """Learning rate of step t = 1, 2, ... of T = total, with w warm-up steps and peak r.

        r t / w for t <= w; then, by schedule, r sqrt(w / t), or r (f + (1 - f) (1 + cos(pi x)) / 2)
        with x = (t - w) / (T - w) and f = final, or r.
        """
        warmup = max(self.warmup, 1)
        if step <= warmup or self.schedule == "constant":
            return self.rate * min(1.0, step / warmup)
        if self.schedule == "inverse-sqrt":
            return self.rate * math.sqrt(warmup / step)
        done = min(1.0, (step - warmup) / max(total - warmup, 1))
        return self.rate * (
            self.final + (1.0 - self.final) * 0.5 * (1.0 + math.cos(math.pi * done))
        )


def batch_seed(seed: int, epoch: int, batch: int) -> np.random.SeedSequence:
    """Return the seed of all random numbers of a batch."""
    return np.random.SeedSequence((seed, epoch, batch))


class Batches(Dataset):
    """Batches of an epoch, as arrays by name; each depends only on seed, epoch and its number."""

    def __init__(
        self,
        rows: Sequence[np.ndarray] | np.ndarray,
        make: Callable[[np.ndarray, np.random.Generator], dict[str, np.ndarray]],
        seed: int,
        epoch: int,
    ) -> None:
        """Prepare batches.

        Args:
            rows: rows of the dataset (paths, waypoints or scenes) for each batch.
            make: makes a batch of its rows and random numbers.
            seed: seed of the training.
            epoch: number of the epoch.
        """
        self._rows, self._make, self._seed = rows, make, (seed, epoch)

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[dict[str, np.ndarray]]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, number: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(batch_seed(*self._seed, number))
        return self._make(self._rows[number], rng)


class Stage(nn.Module, ABC):
    """A training stage, run by `trainer`: the parameters that it trains, batches and losses."""

    selection: ClassVar[str]  # column of the curves; the model with its smallest value is kept
    dataset: TrainingData

    def __init__(self, optimizer: OptimizerSettings, seed: int, device: torch.device) -> None:
        super().__init__()
        self.optimizer, self.seed, self.device = optimizer, seed, device
        torch.manual_seed(seed)

    def prepare(self) -> None:
        """Initialise the model; called once, before the first step. By default nothing is done."""

    @abstractmethod
    def batches(self, epoch: int) -> Batches:
        """Return the batches of an epoch."""

    @abstractmethod
    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Compute the losses of a batch, scalars; ``loss`` is minimised."""

    def after_step(self, epoch: int, step: int, optimizer: torch.optim.Optimizer) -> None:
        """Change parameters after a step of the optimizer. By default nothing is done."""

    @abstractmethod
    def validate(self) -> dict[str, float | None]:
        """Compute metrics of the held-out paths, in evaluation mode."""

    @abstractmethod
    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """Return the model with its present weights, to be saved."""

    def tensors(self, arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
        """Move a batch's arrays to the stage's device."""
        return {name: torch.from_numpy(array).to(self.device) for name, array in arrays.items()}


def means(parts: Iterable[tuple[str, float, float]]) -> dict[str, float | None]:
    """Mean of the values of each name, from partial sums (name, sum, count); None if no values."""
    totals: dict[str, float] = {}
    counts: dict[str, float] = {}
    for name, total, count in parts:
        totals[name] = totals.get(name, 0.0) + total
        counts[name] = counts.get(name, 0.0) + count
    return {name: totals[name] / counts[name] if counts[name] else None for name in totals}
