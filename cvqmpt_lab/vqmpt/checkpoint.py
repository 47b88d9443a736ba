"""Trained models as torch modules, to and from weights on disk; every tensor is checked."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.config import ModelConfig, MPNetConfig
from cvqmpt_lab.vqmpt.dictionary import Dictionary
from cvqmpt_lab.vqmpt.mpnet import MPNet
from cvqmpt_lab.vqmpt.published_network import PublishedSequenceModel
from cvqmpt_lab.vqmpt.scene_transformer import SceneTransformer
from cvqmpt_lab.vqmpt.weights import (
    MPNET,
    VQ_MPT,
    RobotSignature,
    StoredModel,
    read_model,
    write_model,
)

Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A VQ-MPT model and what it belongs to."""

    architecture: ClassVar[str] = VQ_MPT

    config: ModelConfig
    robot: RobotSignature
    dictionary: Dictionary
    sequence_model: PublishedSequenceModel | None = None  # None after stage 1 and in compact models
    metadata: Mapping[str, Any] = field(default_factory=dict)  # json values: how it was trained
    transformer: SceneTransformer | None = None

    @property
    def parts(self) -> dict[str, nn.Module]:
        """Modules by the name of their weights file."""
        parts = {
            "dictionary": self.dictionary,
            "sequence_model": self.sequence_model,
            "transformer": self.transformer,
        }
        return {name: module for name, module in parts.items() if module is not None}


@dataclass(frozen=True, eq=False)
class MPNetCheckpoint:
    """A trained MPNet and what it belongs to."""

    architecture: ClassVar[str] = MPNET

    robot: RobotSignature
    network: MPNet
    metadata: Mapping[str, Any] = field(default_factory=dict)  # json values: how it was trained

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
    parts: dict[str, Mapping[str, np.ndarray]] = {
        name: {
            key: tensor.detach().cpu().numpy().copy() for key, tensor in module.state_dict().items()
        }
        for name, module in checkpoint.parts.items()
    }
    return StoredModel(
        checkpoint.architecture, checkpoint.config, checkpoint.robot, parts, checkpoint.metadata
    )


def save_checkpoint(folder: Path, checkpoint: Trained) -> None:
    """Write a checkpoint; see `write_model`, also for errors."""
    write_model(folder, stored(checkpoint))


def load_checkpoint(folder: Path, robot: RobotSignature | None = None) -> Checkpoint:
    """Read a VQ-MPT checkpoint; errors as of `read_model` and `as_modules`."""
    return as_modules(read_model(folder, robot, VQ_MPT))


def as_modules(model: StoredModel) -> Checkpoint:
    """VQ-MPT's weights as CPU modules in evaluation mode; InvalidInputError if sizes do not fit."""
    builders: dict[str, Callable[[], nn.Module]] = {
        "dictionary": lambda: Dictionary(model.config),
        "sequence_model": lambda: PublishedSequenceModel(model.config),
        "transformer": lambda: SceneTransformer(model.config.transformer),
    }
    modules: dict[str, Any] = {
        name: filled(
            build, {key: torch.from_numpy(a) for key, a in model.parts[name].items()}, name
        )
        for name, build in builders.items()
        if name in model.parts
    }
    return Checkpoint(model.config, model.robot, metadata=model.metadata, **modules)


@torch.inference_mode()
def trajectory_codes(model: StoredModel, configurations: np.ndarray) -> np.ndarray:
    """Codes (t,) int64 of a trajectory's configurations (t, configuration_dim), by any encoder."""
    return as_modules(model).dictionary.encode(torch.from_numpy(configurations)[None])[0].numpy()


def filled(
    build: Callable[[], Module],
    tensors: Mapping[str, Tensor],
    where: str,
    tolerance: float = 1e-4,
) -> Module:
    """Make a module with exactly these trained tensors, in evaluation mode.

    Names and shapes are compared first, so that sizes from a wrong file cost no time or memory.

    Args:
        build: makes the module.
        tensors: its state.
        where: begins the error line.
        tolerance: of constant buffers, and of the length of codes.

    Raises:
        InvalidInputError: tensors are missing, left over, of another shape or kind, or not finite,
            or impossible after training: negative variances, codes that are not of unit length,
            constants of another model.
    """
    # a "meta" module has shapes but no data
    with torch.device("meta"):
        _require_fit(build(), tensors, where)
    module = build().eval()
    expected = module.state_dict()
    bad = [name for name, t in tensors.items() if not t.to(expected[name].dtype).isfinite().all()]
    _refuse([f"{name} has NaN or infinite values" for name in bad], where)
    faults = []
    for name, tensor in tensors.items():
        last = name.rsplit(".", 1)[-1]
        constant = last in ("pos_table", "l_index")  # buffers that follow from the sizes
        if constant and (tensor - expected[name]).abs().max() > tolerance:
            faults.append(f"{name} is not that of this model's sizes")
        if last == "running_var" and (tensor < 0.0).any():
            faults.append(f"{name} has negative variances")
        codes = f".{name}".endswith(".embedding.weight")  # planning needs codes of unit length
        if codes and ((tensor.norm(dim=1) - 1.0).abs() > tolerance).any():
            faults.append(f"{name} has codes that are not of unit length")
    _refuse(faults, where)
    module.load_state_dict(dict(tensors))
    return module


def _require_fit(module: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    expected = module.state_dict()
    faults = [f"{name} is missing" for name in expected if name not in tensors]
    for name, tensor in sorted(tensors.items()):
        if name not in expected:
            faults.append(f"{name} {tuple(tensor.shape)} is left over")
        elif tensor.shape != expected[name].shape:
            faults.append(
                f"{name} is {tuple(tensor.shape)}, expected {tuple(expected[name].shape)}"
            )
        elif tensor.is_floating_point() != expected[name].is_floating_point():
            faults.append(f"{name} is {tensor.dtype}, expected {expected[name].dtype}")
        elif tensor.layout != torch.strided or tensor.is_meta or tensor.is_quantized:
            faults.append(f"{name} is sparse, quantized or without data")
    _refuse(faults, where)


def _refuse(faults: list[str], where: str) -> None:
    if faults:
        more = f" and {len(faults) - 5} more" if len(faults) > 5 else ""
        raise InvalidInputError(
            f"{where} does not fit its configuration: {'; '.join(faults[:5])}{more}"
        )
