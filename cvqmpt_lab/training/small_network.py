"""Training of the small networks that planning asks in compiled code: seconds to minutes, no stages, no GPU."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

Loss = Callable[[Callable[[Tensor], Tensor], Tensor], Tensor]
"""Of the network, and the rows (b,) of examples to judge it by."""


@dataclass(frozen=True, kw_only=True)
class SmallNetworkSettings:
    """How large it is and how it is trained."""

    hidden: tuple[int, int] = (32, 16)
    """Units of the two layers."""
    epochs: int = 20
    batch: int = 1024
    rate: float = 3e-3
    """Of Adam at the beginning; it falls to nothing as a cosine."""


def train_small_network(
    inputs: int, examples: int, loss: Loss, seed: int, settings: SmallNetworkSettings
) -> dict[str, np.ndarray]:
    """Minimise a loss over examples; float32 arrays by their names in `planning.small_network.SmallNetwork`."""
    torch.manual_seed(seed)
    wide, narrow = settings.hidden
    layers = [nn.Linear(inputs, wide), nn.Linear(wide, narrow), nn.Linear(narrow, 1)]
    network = nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])
    optimizer = torch.optim.Adam(network.parameters(), settings.rate)
    batches = -(-examples // settings.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.epochs * batches)
    for _ in range(settings.epochs):
        for rows in torch.randperm(examples).split(settings.batch):
            value = loss(lambda features: network(features)[..., 0], rows)
            optimizer.zero_grad()
            value.backward()
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


def train_sight(
    features: np.ndarray, free: np.ndarray, seed: int, settings: SmallNetworkSettings | None = None
) -> dict[str, np.ndarray]:
    """Learn log odds of being free, as `planning.sight.Eyes` uses them.

    Parameters
    ----------
    features: (b, i), inputs as `kernels.search.sight` computes them. free: (b,) bool.
    """
    inputs = torch.as_tensor(features, dtype=torch.float32)
    targets = torch.as_tensor(free, dtype=torch.float32)

    def loss(network: Callable[[Tensor], Tensor], rows: Tensor) -> Tensor:
        return nn.functional.binary_cross_entropy_with_logits(network(inputs[rows]), targets[rows])

    return train_small_network(inputs.shape[1], len(inputs), loss, seed, settings or SmallNetworkSettings())
