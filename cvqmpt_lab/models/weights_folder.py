"""Weights on disk: a folder of ``config.json`` and safetensors files, one for each part of a model.

``config.json`` says what architecture and sizes, the robot it was trained for, the sha256 of each weights
file and free metadata. A folder is written beside its place and moved there when complete.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.robot_signature import RobotSignature

FORMAT = "cvqmpt-model-1"
CONFIG_FILE = "config.json"


@dataclass(frozen=True)
class Description:
    """What ``config.json`` says beside its format.

    Attributes
    ----------
    architecture: which loader reads the folder.
    model: sizes and options, as that architecture's configuration writes them.
    robot: whose weights these are.
    metadata: anything, as json values.
    sha256: of each part's file, by part.
    """

    architecture: str
    model: Mapping[str, Any]
    robot: RobotSignature
    metadata: Mapping[str, Any]
    sha256: Mapping[str, str]


def write_weights(
    folder: Path,
    architecture: str,
    model: Mapping[str, Any],
    robot: RobotSignature,
    metadata: Mapping[str, Any],
    parts: Mapping[str, nn.Module],
) -> None:
    """Write a folder, replacing an earlier one at once or not at all; see `Description`.

    Raises
    ------
    InvalidInputError
        When the disk refuses; nothing is left behind.
    """
    folder = Path(folder)
    beside = folder.parent / f".{folder.name}.partial-{os.getpid()}"
    try:
        shutil.rmtree(beside, ignore_errors=True)  # of a killed process that had this number
        beside.mkdir(parents=True)
        hashes = {name: _write_part(beside, name, module) for name, module in parts.items()}
        description = {
            "format": FORMAT,
            "architecture": architecture,
            "model": dict(model),
            "robot": robot.to_json(),
            "sha256": hashes,
            "metadata": dict(metadata),
        }
        _write_durably(beside / CONFIG_FILE, (json.dumps(description, indent=2) + "\n").encode())
        _move_into_place(beside, folder)
    except OSError as error:
        raise InvalidInputError(
            f"cannot write weights to {folder}: {error.strerror}; free some space or choose another folder"
        ) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _write_part(folder: Path, name: str, module: nn.Module) -> str:
    """Write one part's tensors and return the sha256 of the file."""
    tensors = {key: tensor.detach().cpu().contiguous() for key, tensor in module.state_dict().items()}
    data = safetensors.torch.save(tensors)
    _write_durably(folder / f"{name}.safetensors", data)
    return hashlib.sha256(data).hexdigest()


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


def read_description(folder: Path, architecture: str, robot: RobotSignature | None = None) -> Description:
    """Read ``config.json``.

    Raises
    ------
    InvalidInputError
        When it is missing or malformed, describes another architecture, or names another robot than
        `robot`, if given.
    """
    path = Path(folder) / CONFIG_FILE
    data = read_json_object(path)
    for name, expected in (("format", FORMAT), ("architecture", architecture)):
        if data.get(name) != expected:
            raise InvalidInputError(f"{path}: {name} is {data.get(name)!r}; expected {expected!r}")
    for name in ("model", "robot", "sha256", "metadata"):
        if not isinstance(data.get(name), dict):
            raise InvalidInputError(f"{path}: {name} is {data.get(name)!r}; it must be an object")
    signature = RobotSignature.from_json(data["robot"], f"{path}: robot")
    if robot is not None:
        signature.require_same(robot)
    return Description(architecture, data["model"], signature, data["metadata"], data["sha256"])


def load_part(folder: Path, description: Description, name: str, module: nn.Module) -> None:
    """Fill a module, made for `description`, with the weights of its part.

    Raises
    ------
    InvalidInputError
        When the part is not listed, its file is missing or damaged, or does not fit the module.
    """
    path = Path(folder) / f"{name}.safetensors"
    expected = description.sha256.get(name)
    if expected is None:
        listed = ", ".join(description.sha256) or "nothing"
        raise InvalidInputError(f"{Path(folder) / CONFIG_FILE}: sha256 lists {listed}; it must list {name}")
    load_tensors(module, _read_weights(path, expected), str(path))


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
