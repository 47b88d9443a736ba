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


@dataclass(frozen=True, kw_only=True)
class OptimizerSettings:
    """Adam or Adagrad with a learning rate schedule: warm-up, then decay."""

    kind: Literal["adam", "adagrad"] = "adam"
    rate: float  # at the peak
    warmup: int = 200  # steps until there
    # After it: by the inverse square root of steps (published), a cosine to `final`, or constant.
    schedule: Literal["inverse-sqrt", "cosine", "constant"] = "inverse-sqrt"
    final: float = 0.02  # share of the peak at the last epoch of a cosine
    betas: tuple[float, float] = (0.9, 0.98)
    epsilon: float = 1e-9
    weight_decay: float = 0.0
    clip: float | None = None  # longest gradient; None to leave it

    def build(self, module: nn.Module) -> torch.optim.Optimizer:
        """The optimizer of a module's parameters."""
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
        """Rate of step t = 1, 2, ... of T = total, with w steps of warmup and peak r.

        r t / w until w; then r sqrt(w / t), or r (f + (1 - f) (1 + cos(pi x)) / 2) with
        x = (t - w) / (T - w) and f = final, or r.
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
    """Seed of a batch, the only source of its randomness."""
    return np.random.SeedSequence((seed, epoch, batch))


class Batches(Dataset):
    """Batches of an epoch, arrays by name; each depends on seed, epoch and its number alone."""

    def __init__(
        self,
        rows: Sequence[np.ndarray] | np.ndarray,
        make: Callable[[np.ndarray, np.random.Generator], dict[str, np.ndarray]],
        seed: int,
        epoch: int,
    ) -> None:
        """Make a batch of each of `rows`, which number paths, waypoints or scenes."""
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

    selection: ClassVar[str]  # the column of the curves whose least value is the best model
    dataset: TrainingData

    def __init__(self, optimizer: OptimizerSettings, seed: int, device: torch.device) -> None:
        super().__init__()
        self.optimizer, self.seed, self.device = optimizer, seed, device
        torch.manual_seed(seed)

    # most stages have nothing to prepare
    def prepare(self) -> None:
        """Called once, before the first step of a training."""

    @abstractmethod
    def batches(self, epoch: int) -> Batches:
        """Batches of an epoch."""

    @abstractmethod
    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Losses of a batch, scalars; ``loss`` is minimised."""

    # most stages change nothing else
    def after_step(self, epoch: int, step: int, optimizer: torch.optim.Optimizer) -> None:
        """Called after each step of the optimizer."""

    @abstractmethod
    def validate(self) -> dict[str, float | None]:
        """Metrics of the held-out paths, in evaluation mode."""

    @abstractmethod
    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """The model in its present state, to be saved."""

    def tensors(self, arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
        """A batch's arrays on the stage's device."""
        return {name: torch.from_numpy(array).to(self.device) for name, array in arrays.items()}


def means(parts: Iterable[tuple[str, float, float]]) -> dict[str, float | None]:
    """Mean of every name's values, from (name, sum, count) of parts of them; None of no value."""
    sums: dict[str, tuple[float, float]] = {}
    for name, total, count in parts:
        before = sums.get(name, (0.0, 0.0))
        sums[name] = before[0] + total, before[1] + count
    return {name: total / count if count else None for name, (total, count) in sums.items()}
