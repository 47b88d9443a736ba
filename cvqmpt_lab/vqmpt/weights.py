"""Weights on disk, found by name or folder and read as plain arrays.

A folder of weights holds ``config.json`` (architecture, sizes, robot, sha256 of each file, free
metadata) and one safetensors file for each part of the model. It is written under a temporary name
and renamed when it is complete.
"""

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.files import read_bytes, read_json_object, write_bytes
from cvqmpt_lab.vqmpt.config import ModelConfig, MPNetConfig

MODEL_FORMAT = "cvqmpt-model-1"
CONFIG_FILE = "config.json"
TRAINED_FOLDER = "model"  # subfolder of a training's folder that holds its best weights
VQ_MPT, MPNET = "vq-mpt", "mpnet"  # architectures
ARCHITECTURES: dict[str, tuple[type[ModelConfig] | type[MPNetConfig], tuple[str, ...]]] = {
    VQ_MPT: (ModelConfig, ("dictionary", "sequence_model", "transformer")),
    MPNET: (MPNetConfig, ("mpnet",)),
}
"""Configuration class and parts of each architecture; only the first part is in every model."""
TRANSFORMER = "transformer"  # name of the scene transformer's part
TRAINED_BY = {
    TRANSFORMER: "train one: cvqmpt train transformer --data DIR --out DIR",
    "sequence_model": "train one: cvqmpt train published --data DIR --out DIR",
}
WEIGHTS_FOLDER = Path(__file__).parents[1] / "weights"
SHIPPED = {"vq_mpt": VQ_MPT, "mpnet": MPNET}
"""Name and architecture of the weights that come with the package."""


class OtherRobotError(InvalidInputError):
    """Weights of one robot are used for another robot."""


@dataclass(frozen=True)
class RobotSignature:
    """The robot of a model's weights; names are compared only if a digest is not known."""

    name: str
    lower: tuple[float, ...]  # (n,) joint limits by which joints are normalised [rad or m]
    upper: tuple[float, ...]  # (n,) [rad or m]
    joints: tuple[str, ...] = ()  # (n,) names; empty in weights of earlier versions
    kinematics: str = ""  # Robot.kinematics_digest; empty in weights of earlier versions

    def __post_init__(self) -> None:
        limits = len(self.lower)
        ordered = all(map(float.__lt__, self.lower, self.upper))
        if not limits or limits != len(self.upper) or not ordered:
            raise InvalidInputError(
                f"lower {self.lower} and upper {self.upper} are no joint limits"
            )
        if self.joints and len(self.joints) != limits:
            raise InvalidInputError(f"{len(self.joints)} names of joints, but {limits} limits")

    def require_same(self, other: "RobotSignature") -> None:
        """Raise OtherRobotError with the differences unless `other` is this robot."""
        differences = self.differences(other)
        if differences:
            name = "this one" if self.name == other.name else repr(other.name)
            raise OtherRobotError(
                f"weights are for robot {self.name!r}, not {name}: {'; '.join(differences)}; "
                "choose weights trained for it, or train some: cvqmpt data generate --robot "
                f"{other.name} --out DATA, then cvqmpt train stage1 --data DATA --out DIR"
            )

    def differences(self, other: "RobotSignature", tolerance: float = 1e-4) -> list[str]:
        """List the differences of another robot; limits may differ by a tolerance [rad or m]."""
        if len(self.lower) != len(other.lower):
            return [f"{len(self.lower)} joints, not {len(other.lower)}"]
        if self.joints and other.joints and self.joints != other.joints:
            pairs = zip(self.joints, other.joints, strict=True)
            ours, theirs = next(pair for pair in pairs if pair[0] != pair[1])
            return [f"joint {ours!r}, not {theirs!r}"]
        limits = [
            f"{side} limit of joint {joint} {our:g}, not {their:g}"
            for side in ("lower", "upper")
            for joint, (our, their) in enumerate(
                zip(getattr(self, side), getattr(other, side), strict=True)
            )
            if not abs(our - their) <= tolerance
        ]
        if limits:
            return limits[:2]
        # weights of earlier versions have no digest: then the names are compared
        if not (self.kinematics and other.kinematics):
            return [] if self.name == other.name else ["another name, and no digest to compare"]
        if self.kinematics == other.kinematics:
            return []
        return [
            f"other positions of its joints (kinematics {self.kinematics[:8]}, not "
            f"{other.kinematics[:8]})"
        ]


@dataclass(frozen=True, eq=False)
class StoredModel:
    """A trained model as plain arrays."""

    config: Any  # an instance of a configuration class of ARCHITECTURES
    robot: RobotSignature
    parts: Mapping[str, Mapping[str, np.ndarray]]  # name of the part -> name of the array -> array
    metadata: Mapping[str, Any] = field(default_factory=dict)  # json values: how it was trained

    def __post_init__(self) -> None:
        limits, joints = len(self.robot.lower), self.config.joint_dim
        if limits != joints:
            raise InvalidInputError(
                f"robot {self.robot.name!r} has limits of {limits} joints, the model {joints} "
                "joints"
            )

    @property
    def architecture(self) -> str:
        """Name of the architecture, a key of ARCHITECTURES."""
        return next(
            name for name, (sizes, _) in ARCHITECTURES.items() if isinstance(self.config, sizes)
        )

    def require_part(self, part: str) -> None:
        """Raise InvalidInputError if the model has no such part."""
        if part not in self.parts:
            cure = f"; {TRAINED_BY[part]}" if part in TRAINED_BY else ""
            raise InvalidInputError(f"the model has no {part}, only {', '.join(self.parts)}{cure}")

    def array(self, part: str, name: str, *shape: int) -> np.ndarray:
        """Return an array of a part in float64.

        Raises:
            InvalidInputError: it is missing, has another shape, or is not finite.
        """
        self.require_part(part)
        array = self.parts[part].get(name)
        if array is None:
            fault = "is missing"
        elif array.shape != shape:
            fault = f"is {array.shape}, expected {shape}"
        elif array.dtype.kind != "f":
            fault = f"is {array.dtype}, expected float32"
        elif not np.isfinite(array).all():
            fault = "has NaN or infinite values"
        else:
            return array.astype(np.float64)
        raise InvalidInputError(f"{part} does not fit its configuration: {name} {fault}")

    def linear(
        self, part: str, name: str, inputs: int, outputs: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return weight (outputs, inputs) and bias (outputs,) of a linear layer, in float64.

        Args:
            part: name of the part.
            name: name of the layer.
            inputs: number of inputs.
            outputs: number of outputs.

        Raises:
            InvalidInputError: as of `array`.
        """
        weight = self.array(part, f"{name}.weight", outputs, inputs)
        return weight, self.array(part, f"{name}.bias", outputs)


def write_model(folder: Path, model: StoredModel) -> None:
    """Write a folder of weights and replace an earlier one; after an error nothing has changed.

    Raises:
        InvalidInputError: weights are not finite, or the folder cannot be written.
    """
    folder = Path(folder)
    # both are on the same file system, so that renaming is atomic
    partial = folder.parent / f".{folder.name}.partial"
    earlier = folder.parent / f".{folder.name}.earlier"
    try:
        # a killed process may have left them
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(earlier, ignore_errors=True)
        partial.mkdir(parents=True)
        sha256 = {}
        for part, arrays in model.parts.items():
            for name, array in arrays.items():
                if not np.isfinite(array).all():
                    raise InvalidInputError(
                        f"cannot write {part}: {name} has NaN or infinite values"
                    )
            data = safetensors.numpy.save(
                {name: np.asarray(array, order="C") for name, array in arrays.items()}
            )
            write_bytes(partial / f"{part}.safetensors", data)
            sha256[part] = hashlib.sha256(data).hexdigest()
        description = {
            "format": MODEL_FORMAT,
            "architecture": model.architecture,
            "model": to_plain(model.config, complete=True),
            "robot": to_plain(model.robot),
            "sha256": sha256,
            "metadata": dict(model.metadata),
        }
        write_bytes(partial / CONFIG_FILE, (json.dumps(description, indent=2) + "\n").encode())
        if folder.exists():
            folder.rename(earlier)
        partial.rename(folder)
        shutil.rmtree(earlier, ignore_errors=True)
    except OSError as error:
        raise InvalidInputError(
            f"cannot write weights to {folder}: {error.strerror}; free some space or choose "
            "another folder"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def recover_weights(folder: Path) -> None:
    """Restore weights that a killed `write_model` had renamed; no other process may be writing."""
    earlier = folder.parent / f".{folder.name}.earlier"
    if earlier.exists() and not folder.exists():
        earlier.rename(folder)


def read_description(
    folder: Path, architecture: str | None = None, robot: RobotSignature | None = None
) -> dict[str, Any]:
    """Read ``config.json``, with the robot as `RobotSignature`.

    Args:
        folder: folder of the weights.
        architecture: required architecture, a key of ARCHITECTURES; None for any.
        robot: required robot; None for any.

    Returns:
        The fields that `write_model` writes.

    Raises:
        InvalidInputError: the file is missing or malformed, or of another architecture.
        OtherRobotError: the weights are for another robot.
    """
    path = Path(folder) / CONFIG_FILE
    data = read_json_object(path, "weights")
    for name, expected in (("format", MODEL_FORMAT), ("architecture", architecture)):
        if expected is not None and data.get(name) != expected:
            raise InvalidInputError(f"{path}: {name} is {data.get(name)!r}; expected {expected!r}")
    for name in ("model", "robot", "sha256", "metadata"):
        if not isinstance(data.get(name), dict):
            raise InvalidInputError(f"{path}: {name} is {data.get(name)!r}; it must be an object")
    signature = from_plain(RobotSignature, data["robot"], f"{path}: robot")
    if robot is not None:
        signature.require_same(robot)
    return {**data, "architecture": str(data.get("architecture")), "robot": signature}


def read_model(
    folder: Path,
    robot: RobotSignature | None = None,
    architecture: str | None = None,
    left_out: str = "",
) -> StoredModel:
    """Read a folder of weights.

    Args:
        folder: folder of the weights.
        robot: required robot; None for any.
        architecture: required architecture, a key of ARCHITECTURES; None for any.
        left_out: name of a part that is not read.

    Raises:
        InvalidInputError: a file is missing or damaged (sha256), or a field is wrong.
        OtherRobotError: the weights are for another robot.
    """
    description = read_description(folder, architecture, robot)
    listed = description["sha256"]
    found = require_choice(
        f"architecture in {Path(folder) / CONFIG_FILE}", description["architecture"], ARCHITECTURES
    )
    sizes, (first, *others) = ARCHITECTURES[found]
    config = from_plain(sizes, description["model"], "model", complete=True)
    names = [first, *(name for name in others if name in listed and name != left_out)]
    parts = {name: _read_part(folder, listed, name) for name in names}
    return StoredModel(config, description["robot"], parts, description["metadata"])


def _read_part(folder: Path, sha256: Mapping[str, str], name: str) -> dict[str, np.ndarray]:
    path, expected = Path(folder) / f"{name}.safetensors", sha256.get(name)
    if expected is None:
        listed = ", ".join(sha256) or "nothing"
        raise InvalidInputError(
            f"{Path(folder) / CONFIG_FILE}: sha256 lists {listed}; it must list {name}"
        )
    # read once, so that the digest covers the bytes that are used
    data = read_bytes(path, "weights")
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise InvalidInputError(
            f"{path} is damaged: sha256 {found[:12]}..., {CONFIG_FILE} says "
            f"{str(expected)[:12]}...; fetch it again"
        )
    try:
        return safetensors.numpy.load(data)
    # KeyError: a data type that numpy does not have
    except (SafetensorError, KeyError) as error:
        raise InvalidInputError(f"{path} is not a usable safetensors file: {error}") from error


def weights_digest(folder: Path) -> str:
    """Compute one sha256 of the names and contents of ``config.json`` and all files of tensors."""
    digest = hashlib.sha256()
    for path in (Path(folder) / CONFIG_FILE, *sorted(Path(folder).glob("*.safetensors"))):
        digest.update(
            f"{path.name} {hashlib.sha256(read_bytes(path, 'weights')).hexdigest()}\n".encode()
        )
    return digest.hexdigest()


def checkpoint_folder(folder: Path) -> Path | None:
    """Return this folder if it holds weights, else its subfolder ``model``, else None."""
    for candidate in (Path(folder), Path(folder) / TRAINED_FOLDER):
        if (candidate / CONFIG_FILE).is_file():
            return candidate
    return None


def resolve_model(
    model: str | Path | None = None,
    architecture: str | None = None,
    robot: RobotSignature | None = None,
) -> Path:
    """Return the folder of a model's weights.

    Args:
        model: a name of `SHIPPED`, a folder of weights or of a training; None for the shipped ones.
        architecture: required architecture, a key of ARCHITECTURES; None for any.
        robot: required robot; None for any.

    Raises:
        InvalidInputError: there is no such model, or `read_description` refuses it.
    """
    names = [name for name, kind in SHIPPED.items() if architecture in (None, kind)]
    name = names[0] if model is None else str(model)
    folder = checkpoint_folder(WEIGHTS_FOLDER / name if name in SHIPPED else Path(name))
    if folder is None:
        raise InvalidInputError(
            f"no weights in {model or WEIGHTS_FOLDER / name}; give one of {', '.join(names)}, or "
            "the folder of a model that you trained (cvqmpt train) or imported (cvqmpt model "
            "import)"
        )
    read_description(folder, architecture, robot)
    return folder


@lru_cache(maxsize=8)
def _signature(model: str, kind: str) -> RobotSignature:
    return read_description(resolve_model(model, SHIPPED[kind]), SHIPPED[kind])["robot"]


def incompatibility(model: str, kind: str, robot: RobotSignature) -> str:
    """Return the reason why a model does not fit a robot, or "".

    Args:
        model: name or folder of the weights.
        kind: kind of the model, a name of `SHIPPED`.
        robot: the robot.
    """
    try:
        _signature(model, kind).require_same(robot)
    except OtherRobotError as error:
        return str(error)
    return ""


def robot_signature(robot: Any) -> RobotSignature:
    """Return the signature of a robot, with which weights are compared."""
    lower, upper = tuple(robot.lower.tolist()), tuple(robot.upper.tolist())
    joints = tuple(robot.joint_names)
    return RobotSignature(robot.name, lower, upper, joints, robot.kinematics_digest)


def load_vq_mpt(robot: Any, model: str | Path | None = None) -> StoredModel:
    """Read VQ-MPT for a robot; `model` as in `resolve_model`, errors also as in `read_model`."""
    signature = robot_signature(robot)
    return read_model(resolve_model(model, VQ_MPT, signature), signature, VQ_MPT)
