"""Adam or Adagrad, with a rate that is warmed up and lowered."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn


@dataclass(frozen=True, kw_only=True)
class OptimizerSettings:
    """How weights are changed."""

    kind: Literal["adam", "adagrad"] = "adam"
    rate: float
    """At the peak."""
    warmup: int = 200
    """Steps until there."""
    schedule: Literal["inverse-sqrt", "cosine", "constant"] = "inverse-sqrt"
    """After it: by the inverse square root of steps (published), a cosine to `final`, or constant."""
    final: float = 0.02
    """Share of the peak at the last epoch of a cosine."""
    betas: tuple[float, float] = (0.9, 0.98)
    epsilon: float = 1e-9
    weight_decay: float = 0.0
    clip: float | None = None
    """Longest gradient; None to leave it."""

    def build(self, parameters: Iterator[nn.Parameter]) -> torch.optim.Optimizer:
        """The optimizer."""
        if self.kind == "adagrad":
            return torch.optim.Adagrad(parameters, lr=self.rate)
        return torch.optim.AdamW(
            parameters, lr=self.rate, betas=self.betas, eps=self.epsilon, weight_decay=self.weight_decay
        )

    def rate_at(self, step: int, total: int) -> float:
        """Rate of step 1, 2, ... of `total`."""
        warmup = max(self.warmup, 1)
        if step <= warmup or self.schedule == "constant":
            return self.rate * min(1.0, step / warmup)
        if self.schedule == "inverse-sqrt":
            return self.rate * math.sqrt(warmup / step)
        done = min(1.0, (step - warmup) / max(total - warmup, 1))
        return self.rate * (self.final + (1.0 - self.final) * 0.5 * (1.0 + math.cos(math.pi * done)))
