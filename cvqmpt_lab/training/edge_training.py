"""Training of the edge validity model's network: clearances to log odds of P(edge is free), in seconds to minutes."""

from itertools import pairwise

import numpy as np
import torch
from torch import nn

HIDDEN = (32, 16)  # units of the two layers


def fit_edge_model(
    features: np.ndarray,
    free: np.ndarray,
    seed: int,
    *,
    epochs: int = 20,
    batch: int = 1024,
    rate: float = 3e-3,
) -> dict[str, np.ndarray]:
    """Minimise the negative log-likelihood of verdicts `free` (b,), by Adam with a rate that falls as a cosine.

    features: (b, i) of `vqmpt.edge_model`. Returns float32 arrays by their names in `vqmpt.edge_model.SmallNetwork`.
    """
    inputs, targets = (
        torch.as_tensor(features, dtype=torch.float32),
        torch.as_tensor(free, dtype=torch.float32),
    )
    torch.manual_seed(seed)
    widths = (inputs.shape[1], *HIDDEN, 1)
    layers = [nn.Linear(before, after) for before, after in pairwise(widths)]
    network = nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])
    optimizer = torch.optim.Adam(network.parameters(), rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs * -(-len(inputs) // batch))
    for _ in range(epochs):
        for rows in torch.randperm(len(inputs)).split(batch):
            odds = network(inputs[rows])[..., 0]
            loss = nn.functional.binary_cross_entropy_with_logits(odds, targets[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    arrays: dict[str, np.ndarray] = {}
    for name, layer in zip(("first", "second", "last"), layers, strict=True):
        arrays |= {name: layer.weight.detach().numpy(), f"{name}_bias": layer.bias.detach().numpy()}
    return {**arrays, "last": arrays["last"][0]}
