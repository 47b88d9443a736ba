"""Losses of both stages, masked so that padding never counts (reductions of the published code)."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from cvqmpt_lab.vqmpt.dictionary import DictionaryOutput, Quantized


@dataclass(frozen=True, eq=False)
class Stage1Loss:
    """Parts of the stage-1 loss, scalars; `reconstruction` selects the best model."""

    negative_log_likelihood: Tensor
    negative_entropy: Tensor
    quantization: Tensor
    entropy_weight: float

    @property
    def reconstruction(self) -> Tensor:
        """Negative log likelihood plus weighted negative entropy."""
        return self.negative_log_likelihood + self.entropy_weight * self.negative_entropy

    @property
    def total(self) -> Tensor:
        """What is minimised."""
        return self.reconstruction + self.quantization


def stage1_loss(
    output: DictionaryOutput, u: Tensor, visible: Tensor, commitment: float, entropy_weight: float = 0.1
) -> Stage1Loss:
    """Fit of the dictionary to trajectories.

    Parameters
    ----------
    output
        Of `Dictionary` for the same waypoints.
    u
        (b, t, joint_dim): normalised joints.
    visible
        (b, t) bool: False where padded.
    commitment
        beta of the quantization loss.
    entropy_weight
        Share of the (maximised) entropy; keeps Gaussians wide.
    """
    trajectories = u.shape[0]
    return Stage1Loss(
        -torch.where(visible, output.gaussians.log_prob(u), 0.0).sum() / trajectories,
        -torch.where(visible, output.gaussians.entropy(), 0.0).sum() / trajectories,
        quantization_loss(output.quantized, visible, commitment),
        entropy_weight,
    )


def quantization_loss(quantized: Quantized, visible: Tensor, commitment: float) -> Tensor:
    """Weigh commitment ||sg(z_q) - z||^2 + ||z_q - sg(z)||^2 on latents, mean over visible (b, t) waypoints."""
    z, z_q = quantized.latent, quantized.quantized
    per_waypoint = commitment * (z_q.detach() - z).square().sum(-1) + (z_q - z.detach()).square().sum(-1)
    return per_waypoint[visible].mean()


def sequence_loss(logits: Tensor, targets: Tensor, trajectories: int) -> Tensor:
    """Stage 2: cross entropy of the next code after every prefix, per trajectory.

    Parameters
    ----------
    logits
        (r, n_classes): prediction after each prefix.
    targets
        (r,) int64: the next code of each, the goal class after the last.
    trajectories
        What the sum is divided by.
    """
    return F.cross_entropy(logits, targets, reduction="sum") / trajectories
