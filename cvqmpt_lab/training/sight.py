"""The network that reads clearances: is a straight motion free, given how near the robot's balls come to a cloud?

A dozen numbers a motion and two small layers: it is trained in seconds, without stages, epochs to resume or a GPU.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import nn


@dataclass(frozen=True, kw_only=True)
class SightSettings:
    """How large it is and how it is trained."""

    hidden: tuple[int, int] = (32, 16)
    """Units of the two layers."""
    epochs: int = 20
    batch: int = 1024
    rate: float = 3e-3
    """Of Adam at the beginning; it falls to nothing as a cosine."""


def train_sight(
    features: np.ndarray, free: np.ndarray, seed: int, settings: SightSettings | None = None
) -> dict[str, np.ndarray]:
    """Learn log odds of being free.

    Parameters
    ----------
    features: (b, i), inputs as `kernels.search.sight` computes them. free: (b,) bool.

    Returns
    -------
    float32 arrays by their names in `kernels.search.sight.Sight`; last_bias is (1,).
    """
    settings = settings or SightSettings()
    torch.manual_seed(seed)
    wide, narrow = settings.hidden
    layers = [nn.Linear(features.shape[1], wide), nn.Linear(wide, narrow), nn.Linear(narrow, 1)]
    network = nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])
    inputs, targets = (
        torch.as_tensor(features, dtype=torch.float32),
        torch.as_tensor(free, dtype=torch.float32),
    )
    optimizer = torch.optim.Adam(network.parameters(), settings.rate)
    batches = -(-len(inputs) // settings.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.epochs * batches)
    for _ in range(settings.epochs):
        for rows in torch.randperm(len(inputs)).split(settings.batch):
            loss = nn.functional.binary_cross_entropy_with_logits(network(inputs[rows])[:, 0], targets[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    first, second, last = ((layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in layers)
    return {
        "first": first[0],
        "first_bias": first[1],
        "second": second[0],
        "second_bias": second[1],
        "last": last[0][0],
        "last_bias": last[1],
    }
