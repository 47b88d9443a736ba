"""The dictionary itself, in radians: a Gaussian for every code, and the codes of given configurations."""

import numpy as np
import torch

from cvqmpt_lab.models.checkpoint import Checkpoint
from cvqmpt_lab.prediction.configurations import ModelConfigurations
from cvqmpt_lab.robot.robot import Robot


@torch.inference_mode()
def dictionary_gaussians(checkpoint: Checkpoint, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Means (codes, n) [rad] and covariances (codes, n, n) [rad^2] of every code, as the decoder gives them."""
    model = ModelConfigurations(checkpoint, robot)
    gaussians = checkpoint.dictionary.code_gaussians()
    means = model.radians(gaussians.mean.numpy().astype(float))
    return means, gaussians.covariance.numpy().astype(float) * np.outer(model.range, model.range)


@torch.inference_mode()
def codes_of(checkpoint: Checkpoint, robot: Robot, configurations: np.ndarray) -> np.ndarray:
    """Code (b,) int64 of each configuration (b, n) [rad] of one path."""
    ends = torch.from_numpy(ModelConfigurations(checkpoint, robot).of(configurations))
    return checkpoint.dictionary.encode(ends[None])[0].numpy()


def drawn_nodes(
    means: np.ndarray, covariances: np.ndarray, robot: Robot, rng: np.random.Generator
) -> np.ndarray:
    """One configuration (codes, n) from each code's Gaussian, inside the limits.

    Means crowd in the middle of where paths pass; draws cover it as training's waypoints do.
    """
    noise = rng.standard_normal(means.shape)
    draws = means + np.einsum("kij,kj->ki", np.linalg.cholesky(covariances), noise)
    return np.clip(draws, robot.lower, robot.upper)
