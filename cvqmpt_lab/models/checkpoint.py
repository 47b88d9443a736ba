"""Weights on disk: a folder of ``config.json`` and one safetensors file for each stage.

``config.json`` holds the model's configuration, the robot it was trained for, the sha256 of each
weights file and free metadata. A folder is written beside its place and moved there when complete.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.compact_sequence_model import CompactSequenceModel
from cvqmpt_lab.models.config import ModelConfig
from cvqmpt_lab.models.dictionary import Dictionary
from cvqmpt_lab.models.sequence_model import PublishedSequenceModel

FORMAT = "cvqmpt-model-1"
CONFIG_FILE = "config.json"
LIMIT_TOLERANCE = 1e-4
"""Joint limits that differ by less are the same robot's [rad or m]."""


@dataclass(frozen=True)
class RobotSignature:
    """The robot that weights belong to: its name and joint limits [rad or m], by which joints are scaled."""

    name: str
    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def require_same(self, other: "RobotSignature") -> None:
        """Compare with the robot at hand.

        Raises
        ------
        InvalidInputError
            Naming the first difference.
        """
        if self.name != other.name:
            raise InvalidInputError(
                f"weights are for robot {self.name!r}, not {other.name!r}; choose weights trained for it"
            )
        if len(self.lower) != len(other.lower):
            raise InvalidInputError(
                f"weights are for {len(self.lower)} joints of {self.name!r}, not {len(other.lower)}"
            )
        for side in ("lower", "upper"):
            for joint, (ours, theirs) in enumerate(
                zip(getattr(self, side), getattr(other, side), strict=True)
            ):
                if abs(ours - theirs) > LIMIT_TOLERANCE:
                    raise InvalidInputError(
                        f"weights are for a {self.name!r} whose {side} limit of joint {joint} is {ours:g}, "
                        f"not {theirs:g}; use that robot description"
                    )


SequenceModel = PublishedSequenceModel | CompactSequenceModel
_SEQUENCE_MODELS: dict[str, type[PublishedSequenceModel] | type[CompactSequenceModel]] = {
    "published": PublishedSequenceModel,
    "compact": CompactSequenceModel,
}


def build_sequence_model(config: ModelConfig) -> SequenceModel:
    """Stage 2 as `config.kind` asks for, with random weights."""
    return _SEQUENCE_MODELS[config.kind](config)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A model and what it belongs to; `sequence_model` is None after stage 1 alone."""

    config: ModelConfig
    robot: RobotSignature
    dictionary: Dictionary
    sequence_model: SequenceModel | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.robot.lower) != self.config.joint_dim or len(self.robot.upper) != self.config.joint_dim:
            raise InvalidInputError(
                f"robot {self.robot.name!r} has limits of {len(self.robot.lower)} joints, "
                f"the model {self.config.joint_dim} joints"
            )

    @property
    def parts(self) -> dict[str, nn.Module]:
        """Modules by the name of their weights file."""
        parts: dict[str, nn.Module] = {"dictionary": self.dictionary}
        if self.sequence_model is not None:
            parts["sequence_model"] = self.sequence_model
        return parts


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint, replacing an earlier one in `folder` at once or not at all.

    Raises
    ------
    InvalidInputError
        When the disk refuses; nothing is left behind.
    """
    folder = Path(folder)
    beside = folder.parent / f".{folder.name}.partial-{os.getpid()}"
    try:
        beside.mkdir(parents=True)
        _write_files(beside, checkpoint)
        _move_into_place(beside, folder)
    except OSError as error:
        raise InvalidInputError(
            f"cannot write weights to {folder}: {error.strerror}; free some space or choose another folder"
        ) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _write_files(folder: Path, checkpoint: Checkpoint) -> None:
    weights = {}
    for name, module in checkpoint.parts.items():
        tensors = {key: tensor.detach().cpu().contiguous() for key, tensor in module.state_dict().items()}
        data = safetensors.torch.save(tensors)
        _write_durably(folder / f"{name}.safetensors", data)
        weights[name] = hashlib.sha256(data).hexdigest()
    description = {
        "format": FORMAT,
        "model": checkpoint.config.to_json(),
        "robot": {
            "name": checkpoint.robot.name,
            "lower": list(checkpoint.robot.lower),
            "upper": list(checkpoint.robot.upper),
        },
        "sha256": weights,
        "metadata": dict(checkpoint.metadata),
    }
    _write_durably(folder / CONFIG_FILE, (json.dumps(description, indent=2) + "\n").encode())


def _write_durably(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _move_into_place(source: Path, target: Path) -> None:
    """Rename source to target; an earlier target steps aside first and comes back if that fails."""
    aside = target.parent / f".{target.name}.previous-{os.getpid()}"
    if target.exists():
        target.rename(aside)
    try:
        source.rename(target)
    except OSError:
        if aside.exists():
            aside.rename(target)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def load_checkpoint(folder: Path, robot: RobotSignature | None = None) -> Checkpoint:
    """Read a checkpoint, its modules in evaluation mode on the CPU.

    Parameters
    ----------
    folder
        What `save_checkpoint` wrote.
    robot
        The robot at hand; the weights must belong to it. None to skip the comparison.

    Raises
    ------
    InvalidInputError
        Naming the file that is missing or damaged (sha256), the field of ``config.json`` or the tensor
        that does not fit, or the difference between the robots.
    """
    folder = Path(folder)
    description = _read_description(folder)
    config = ModelConfig.from_json(description["model"])
    signature = _signature(description["robot"], folder)
    if robot is not None:
        signature.require_same(robot)
    hashes = description["sha256"]
    builders = {"dictionary": Dictionary, "sequence_model": build_sequence_model}
    unknown = set(hashes) - set(builders)
    if unknown or "dictionary" not in hashes:
        raise InvalidInputError(
            f"{folder / CONFIG_FILE}: sha256 lists {', '.join(hashes) or 'nothing'}; "
            "it must list dictionary, and may list sequence_model"
        )
    parts: dict[str, Any] = {}
    for name, expected in hashes.items():
        path = folder / f"{name}.safetensors"
        module = builders[name](config)
        load_tensors(module, _read_weights(path, expected), str(path))
        parts[name] = module.eval()
    return Checkpoint(config, signature, **parts, metadata=description["metadata"])


def checkpoint_sha256(folder: Path) -> str:
    """One hash for a whole checkpoint: of ``config.json``, which holds those of the weights."""
    return hashlib.sha256(_read_bytes(Path(folder) / CONFIG_FILE)).hexdigest()


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidInputError(f"cannot read weights {path}: {error.strerror}") from error


def read_json_object(path: Path) -> dict[str, Any]:
    """Read one json object from a file.

    Raises
    ------
    InvalidInputError
        Naming the file that is missing or not a json object.
    """
    try:
        data = json.loads(_read_bytes(path))
    except ValueError as error:
        raise InvalidInputError(f"{path} is not json: {error}") from error
    if not isinstance(data, dict):
        raise InvalidInputError(f"{path} must hold one json object")
    return data


def _read_description(folder: Path) -> dict[str, Any]:
    path = folder / CONFIG_FILE
    description = read_json_object(path)
    if description.get("format") != FORMAT:
        raise InvalidInputError(
            f"{path}: format is {description.get('format')!r}; this version reads {FORMAT!r}"
        )
    for name in ("model", "robot", "sha256", "metadata"):
        if not isinstance(description.get(name), dict):
            raise InvalidInputError(f"{path}: {name} is {description.get(name)!r}; it must be an object")
    return description


def _signature(data: Mapping[str, Any], folder: Path) -> RobotSignature:
    with contextlib.suppress(KeyError, TypeError, ValueError):
        lower, upper = (tuple(float(limit) for limit in data[side]) for side in ("lower", "upper"))
        return RobotSignature(str(data["name"]), lower, upper)
    raise InvalidInputError(f"{folder / CONFIG_FILE}: robot must have a name and lists lower and upper")


def _read_weights(path: Path, expected: str) -> dict[str, Tensor]:
    data = _read_bytes(path)
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise InvalidInputError(
            f"{path} is damaged: sha256 {found[:12]}..., {CONFIG_FILE} says {str(expected)[:12]}...; fetch it again"
        )
    try:
        return safetensors.torch.load(data)
    except SafetensorError as error:
        raise InvalidInputError(f"{path} is not a safetensors file: {error}") from error


def load_tensors(module: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    """Copy tensors into a module of exactly their names and shapes.

    Raises
    ------
    InvalidInputError
        Naming, after `where`, every tensor that is missing, left over, of another shape or not finite.
    """
    expected = module.state_dict()
    faults = [f"{name} is missing" for name in expected if name not in tensors]
    for name, tensor in tensors.items():
        if name not in expected:
            faults.append(f"{name} {tuple(tensor.shape)} is left over")
        elif tensor.shape != expected[name].shape:
            faults.append(f"{name} is {tuple(tensor.shape)}, expected {tuple(expected[name].shape)}")
        elif tensor.is_floating_point() != expected[name].is_floating_point():
            faults.append(f"{name} is {tensor.dtype}, expected {expected[name].dtype}")
        elif not torch.isfinite(tensor).all():
            faults.append(f"{name} has NaN or infinite values")
    if faults:
        more = f" and {len(faults) - 5} more" if len(faults) > 5 else ""
        raise InvalidInputError(f"{where} does not fit its configuration: {'; '.join(faults[:5])}{more}")
    module.load_state_dict(dict(tensors))
