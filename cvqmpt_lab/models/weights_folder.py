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

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from cvqmpt_lab.codec.plain import from_plain, to_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_bytes, read_json_object, require_regular_file, write_bytes
from cvqmpt_lab.models.robot_signature import RobotSignature

FORMAT = "cvqmpt-model-1"
CONFIG_FILE = "config.json"
TRAINED_FOLDER = "model"
"""Where in its folder a training leaves its best weights."""


@dataclass(frozen=True)
class Description:
    """What ``config.json`` says beside its format."""

    architecture: str
    """Which loader reads the folder."""
    model: Mapping[str, Any]
    """Sizes and options, as that architecture's configuration writes them."""
    robot: RobotSignature
    """Whose weights these are."""
    metadata: Mapping[str, Any]
    """Anything, as json values."""
    sha256: Mapping[str, str]
    """Of each part's file, by part."""


def write_weights(
    folder: Path,
    architecture: str,
    model: Mapping[str, Any],
    robot: RobotSignature,
    metadata: Mapping[str, Any],
    parts: Mapping[str, Mapping[str, np.ndarray]],
) -> None:
    """Write a folder, replacing an earlier one at once or not at all; see `Description`.

    Raises
    ------
    InvalidInputError
        For weights that are not finite, or when the disk refuses; nothing is left behind.
    """
    folder = Path(folder)
    beside = folder.parent / f".{folder.name}.partial-{os.getpid()}"
    try:
        shutil.rmtree(beside, ignore_errors=True)  # of a killed process that had this number
        beside.mkdir(parents=True)
        hashes = {name: _write_part(beside, name, arrays) for name, arrays in parts.items()}
        description = {
            "format": FORMAT,
            "architecture": architecture,
            "model": dict(model),
            "robot": to_plain(robot),
            "sha256": hashes,
            "metadata": dict(metadata),
        }
        write_bytes(beside / CONFIG_FILE, (json.dumps(description, indent=2) + "\n").encode())
        _move_into_place(beside, folder)
    except OSError as error:
        raise InvalidInputError(
            f"cannot write weights to {folder}: {error.strerror}; free some space or choose another folder"
        ) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _write_part(folder: Path, name: str, arrays: Mapping[str, np.ndarray]) -> str:
    """Write one part's arrays and return the sha256 of the file."""
    for key, array in arrays.items():
        if not np.isfinite(array).all():
            raise InvalidInputError(f"cannot write {name}: {key} has NaN or infinite values")
    data = safetensors.numpy.save({key: np.asarray(array, order="C") for key, array in arrays.items()})
    write_bytes(folder / f"{name}.safetensors", data)
    return hashlib.sha256(data).hexdigest()


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


def recover_weights(folder: Path) -> None:
    """Finish what a killed `write_weights` left beside `folder`; only for who alone writes there."""
    for aside in folder.parent.glob(f".{folder.name}.previous-*"):
        if folder.exists():
            shutil.rmtree(aside, ignore_errors=True)
        else:
            aside.rename(folder)
    for beside in folder.parent.glob(f".{folder.name}.partial-*"):
        shutil.rmtree(beside, ignore_errors=True)


def checkpoint_folder(folder: Path) -> Path | None:
    """A folder of weights: this one, or the ``model`` that a training left in it; None when it is neither."""
    for candidate in (Path(folder), Path(folder) / TRAINED_FOLDER):
        if (candidate / CONFIG_FILE).is_file():
            return candidate
    return None


def read_description(
    folder: Path, architecture: str | None = None, robot: RobotSignature | None = None
) -> Description:
    """Read ``config.json``.

    Raises
    ------
    InvalidInputError
        When it is missing or malformed, or describes another architecture than `architecture`, if given.
    OtherRobotError
        When the weights belong to another robot than `robot`, if given.
    """
    path = Path(folder) / CONFIG_FILE
    data = read_json_object(require_regular_file(path, "weights"), "weights")
    for name, expected in (("format", FORMAT), ("architecture", architecture)):
        if expected is not None and data.get(name) != expected:
            raise InvalidInputError(f"{path}: {name} is {data.get(name)!r}; expected {expected!r}")
    for name in ("model", "robot", "sha256", "metadata"):
        if not isinstance(data.get(name), dict):
            raise InvalidInputError(f"{path}: {name} is {data.get(name)!r}; it must be an object")
    signature = from_plain(RobotSignature, data["robot"], f"{path}: robot")
    if robot is not None:
        signature.require_same(robot)
    return Description(
        str(data.get("architecture")), data["model"], signature, data["metadata"], data["sha256"]
    )


def read_part(folder: Path, description: Description, name: str) -> dict[str, np.ndarray]:
    """The arrays of a part.

    Raises
    ------
    InvalidInputError
        When the part is not listed, or its file is missing or damaged.
    """
    path = Path(folder) / f"{name}.safetensors"
    expected = description.sha256.get(name)
    if expected is None:
        listed = ", ".join(description.sha256) or "nothing"
        raise InvalidInputError(f"{Path(folder) / CONFIG_FILE}: sha256 lists {listed}; it must list {name}")
    data = read_bytes(require_regular_file(path, "weights"), "weights")
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise InvalidInputError(
            f"{path} is damaged: sha256 {found[:12]}..., {CONFIG_FILE} says {str(expected)[:12]}...; fetch it again"
        )
    try:
        return safetensors.numpy.load(data)
    except (SafetensorError, KeyError) as error:  # a key: a kind of number that numpy has not
        raise InvalidInputError(f"{path} is not a safetensors file that can be used: {error}") from error


def weights_digest(folder: Path) -> str:
    """One sha256 for a whole model: of its ``config.json`` and of every file of tensors, with their names."""
    digest = hashlib.sha256()
    for path in (Path(folder) / CONFIG_FILE, *sorted(Path(folder).glob("*.safetensors"))):
        digest.update(f"{path.name} {hashlib.sha256(read_bytes(path, 'weights')).hexdigest()}\n".encode())
    return digest.hexdigest()
