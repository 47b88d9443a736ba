"""Trained models as torch modules: VQ-MPT (dictionary, and sequence model once there is one) and MPNet."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import nn

from cvqmpt_lab.codec.plain import to_plain
from cvqmpt_lab.models.config import ModelConfig, MPNetConfig
from cvqmpt_lab.models.dictionary.dictionary import Dictionary
from cvqmpt_lab.models.mpnet.network import MPNet
from cvqmpt_lab.models.published.sequence_model import PublishedSequenceModel
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.models.stored import MPNET, VQ_MPT, StoredModel, read_model
from cvqmpt_lab.models.tensors import filled
from cvqmpt_lab.models.weights_folder import write_weights


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A VQ-MPT model and what it belongs to."""

    architecture: ClassVar[str] = VQ_MPT

    config: ModelConfig
    robot: RobotSignature
    dictionary: Dictionary
    sequence_model: PublishedSequenceModel | None = None
    """None after stage 1 alone, which is all of a compact model."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """Json values: how it was trained."""

    @property
    def parts(self) -> dict[str, nn.Module]:
        """Modules by the name of their weights file."""
        parts: dict[str, nn.Module] = {"dictionary": self.dictionary}
        if self.sequence_model is not None:
            parts["sequence_model"] = self.sequence_model
        return parts


@dataclass(frozen=True, eq=False)
class MPNetCheckpoint:
    """A trained MPNet and what it belongs to."""

    architecture: ClassVar[str] = MPNET

    robot: RobotSignature
    network: MPNet
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """Json values: how it was trained."""

    @property
    def config(self) -> MPNetConfig:
        """Sizes of the network."""
        return self.network.config

    @property
    def parts(self) -> dict[str, nn.Module]:
        """Modules by the name of their weights file."""
        return {"mpnet": self.network}


Trained = Checkpoint | MPNetCheckpoint


def stored(checkpoint: Trained) -> StoredModel:
    """A checkpoint's weights as they are now, copied to plain arrays."""
    parts = {
        name: {key: tensor.detach().cpu().numpy().copy() for key, tensor in module.state_dict().items()}
        for name, module in checkpoint.parts.items()
    }
    return StoredModel(
        checkpoint.architecture, checkpoint.config, checkpoint.robot, parts, checkpoint.metadata
    )


def save_checkpoint(folder: Path, checkpoint: Trained) -> None:
    """Write a checkpoint, replacing an earlier one in `folder` at once or not at all.

    Raises
    ------
    InvalidInputError
        When weights are not finite or the disk refuses; nothing is left behind.
    """
    write_weights(
        folder,
        checkpoint.architecture,
        to_plain(checkpoint.config, complete=True),
        checkpoint.robot,
        checkpoint.metadata,
        stored(checkpoint).parts,
    )


def load_checkpoint(folder: Path, robot: RobotSignature | None = None) -> Checkpoint:
    """Read a VQ-MPT checkpoint, its modules in evaluation mode on the CPU.

    Parameters and errors are those of `read_model`; InvalidInputError also names the tensor that does not fit.
    """
    return as_modules(read_model(folder, robot, VQ_MPT))


def as_modules(model: StoredModel) -> Checkpoint:
    """VQ-MPT's weights in torch modules, in evaluation mode; raises InvalidInputError where they do not fit."""
    config = model.config
    builders = {
        "dictionary": lambda: Dictionary(config),
        "sequence_model": lambda: PublishedSequenceModel(config),
    }
    modules: dict[str, Any] = {
        name: filled(build, {key: torch.from_numpy(a) for key, a in model.parts[name].items()}, name)
        for name, build in builders.items()
        if name in model.parts
    }
    return Checkpoint(config, model.robot, metadata=model.metadata, **modules)
