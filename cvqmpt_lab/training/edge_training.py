"""Fits of P(a roadmap's edge is free):
a logistic curve by Newton's method, and a small network to compare it with.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import nn

HIDDEN = (32, 16)  # units of the two layers
NEWTON_STEPS = 30
RIDGE = 1e-6  # times the identity, added to Newton's matrix

LogOdds = Callable[[np.ndarray], np.ndarray]  # of features (b, i): (b,)


def fit_logistic(features: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Weights (i + 1,), the bias last, of log odds that are linear in features (b, i); free:
    verdicts (b,) bool.

    The most likely ones, by Newton's method.
    """
    inputs = np.column_stack([features, np.ones(len(features))])
    weights = np.zeros(inputs.shape[1])
    for _ in range(NEWTON_STEPS):
        probability = 1.0 / (1.0 + np.exp(-inputs @ weights))
        curvature = (inputs * (probability * (1.0 - probability))[:, None]).T @ inputs
        step = np.linalg.solve(
            curvature + RIDGE * np.eye(len(weights)), inputs.T @ (free - probability)
        )
        weights += step
    return weights


def fit_network(
    features: np.ndarray,
    free: np.ndarray,
    seed: int,
    *,
    epochs: int = 20,
    batch: int = 1024,
    rate: float = 3e-3,
) -> LogOdds:
    """Minimise the negative log-likelihood of verdicts `free` (b,), by Adam with a rate that falls
    as a cosine.
    """
    middle, scale = features.mean(axis=0), features.std(axis=0) + 1e-6

    def inputs_of(features: np.ndarray) -> torch.Tensor:
        return torch.as_tensor((features - middle) / scale, dtype=torch.float32)

    inputs, targets = inputs_of(features), torch.as_tensor(free, dtype=torch.float32)
    torch.manual_seed(seed)
    first, second = HIDDEN
    network = nn.Sequential(
        nn.Linear(inputs.shape[1], first),
        nn.ReLU(),
        nn.Linear(first, second),
        nn.ReLU(),
        nn.Linear(second, 1),
    )
    optimizer = torch.optim.Adam(network.parameters(), rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, epochs * -(-len(inputs) // batch)
    )
    for _ in range(epochs):
        for rows in torch.randperm(len(inputs)).split(batch):
            loss = nn.functional.binary_cross_entropy_with_logits(
                network(inputs[rows])[..., 0], targets[rows]
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()

    def log_odds(features: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return network(inputs_of(features))[..., 0].numpy().astype(float)

    return log_odds
