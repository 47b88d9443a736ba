"""Weights on disk, found by name or folder and read as plain arrays.

A folder of weights holds ``config.json`` (architecture, sizes, the robot it was trained for, sha256
of each file, free metadata) and one safetensors file for each part of the model. It is written
beside its place and moved there when it is complete.
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

import cvqmpt_lab
from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.files import read_bytes, read_json_object, write_bytes
from cvqmpt_lab.vqmpt.config import ModelConfig, MPNetConfig

FORMAT = "cvqmpt-model-1"
CONFIG_FILE = "config.json"
TRAINED_FOLDER = "model"  # where in its folder a training leaves its best weights
VQ_MPT, MPNET = "vq-mpt", "mpnet"  # architectures
ARCHITECTURES: dict[str, tuple[type[ModelConfig] | type[MPNetConfig], tuple[str, ...]]] = {
    VQ_MPT: (ModelConfig, ("dictionary", "sequence_model", "transformer")),
    MPNET: (MPNetConfig, ("mpnet",)),
}
"""Sizes and files of each; the first file is always there, the others where they were trained."""
TRANSFORMER = "transformer"
TRAINED_BY = {
    TRANSFORMER: "train one: cvqmpt train transformer --data DIR --out DIR",
    "sequence_model": "train one: cvqmpt train published --data DIR --out DIR",
}
WEIGHTS = Path(cvqmpt_lab.__file__).parent / "weights"
SHIPPED = {"vq_mpt": VQ_MPT, "mpnet": MPNET}
"""Names and architectures of the weights that come with the package."""


class OtherRobotError(InvalidInputError):
    """Weights of one robot are used for another."""


@dataclass(frozen=True)
class RobotSignature:
    """The robot of a model's weights; if both digests are known, its name is not compared."""

    name: str
    lower: tuple[float, ...]  # (n,) joint limits, by which joints are normalised [rad or m]
    upper: tuple[float, ...]  # (n,) [rad or m]
    joints: tuple[str, ...] = ()  # (n,) names; empty where an earlier version did not record them
    kinematics: str = ""  # Robot.kinematics_digest; likewise

    def __post_init__(self) -> None:
        limits = len(self.lower)
        if (
            not limits
            or limits != len(self.upper)
            or not all(map(float.__lt__, self.lower, self.upper))
        ):
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
        """What makes the other another robot; limits may differ by a tolerance [rad or m]."""
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
        # earlier versions recorded no digest; then the name must do
        if not (self.kinematics and other.kinematics):
            return [] if self.name == other.name else ["another name, and no digest to compare"]
        if self.kinematics == other.kinematics:
            return []
        return [
            f"joints placed otherwise (kinematics {self.kinematics[:8]}, not "
            f"{other.kinematics[:8]})"
        ]


@dataclass(frozen=True, eq=False)
class StoredModel:
    """A trained model as plain data."""

    config: Any  # of a type of ARCHITECTURES
    robot: RobotSignature
    parts: Mapping[str, Mapping[str, np.ndarray]]  # arrays by name, by name of the part
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
        """Key of ARCHITECTURES."""
        return next(name for name, (of, _) in ARCHITECTURES.items() if isinstance(self.config, of))

    def require_part(self, part: str) -> None:
        """Raise InvalidInputError when a part was not trained."""
        if part not in self.parts:
            cure = f"; {TRAINED_BY[part]}" if part in TRAINED_BY else ""
            raise InvalidInputError(f"the model has no {part}, only {', '.join(self.parts)}{cure}")

    def array(self, part: str, name: str, *shape: int) -> np.ndarray:
        """An array of a part in float64; InvalidInputError: missing, wrong shape or values."""
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
        """Weight (outputs, inputs) and bias (outputs,) of a linear layer; see `array`."""
        weight = self.array(part, f"{name}.weight", outputs, inputs)
        return weight, self.array(part, f"{name}.bias", outputs)


def write_model(folder: Path, model: StoredModel) -> None:
    """Write a folder of weights in one step, replacing an earlier one; on an error nothing changes.

    Raises:
        InvalidInputError: weights are not finite, or the disk refuses.
    """
    folder = Path(folder)
    # on the same file system, so that the move is atomic; a killed process may have left them
    beside, earlier = (folder.parent / f".{folder.name}.{part}" for part in ("partial", "earlier"))
    try:
        shutil.rmtree(beside, ignore_errors=True)
        shutil.rmtree(earlier, ignore_errors=True)
        beside.mkdir(parents=True)
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
            write_bytes(beside / f"{part}.safetensors", data)
            sha256[part] = hashlib.sha256(data).hexdigest()
        description = {
            "format": FORMAT,
            "architecture": model.architecture,
            "model": to_plain(model.config, complete=True),
            "robot": to_plain(model.robot),
            "sha256": sha256,
            "metadata": dict(model.metadata),
        }
        write_bytes(beside / CONFIG_FILE, (json.dumps(description, indent=2) + "\n").encode())
        if folder.exists():
            folder.rename(earlier)
        beside.rename(folder)
        shutil.rmtree(earlier, ignore_errors=True)
    except OSError as error:
        raise InvalidInputError(
            f"cannot write weights to {folder}: {error.strerror}; free some space or choose "
            "another folder"
        ) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def recover_weights(folder: Path) -> None:
    """Put back what a `write_model` that was killed had moved aside; only for its single writer."""
    earlier = folder.parent / f".{folder.name}.earlier"
    if earlier.exists() and not folder.exists():
        earlier.rename(folder)


def read_description(
    folder: Path, architecture: str | None = None, robot: RobotSignature | None = None
) -> dict[str, Any]:
    """Read ``config.json``: fields as `write_model` writes them, the robot as `RobotSignature`.

    Raises:
        InvalidInputError: it is missing or malformed, or of another architecture than is given.
        OtherRobotError: the weights belong to another robot than is given.
    """
    path = Path(folder) / CONFIG_FILE
    data = read_json_object(path, "weights")
    for name, expected in (("format", FORMAT), ("architecture", architecture)):
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
        folder: of the weights.
        robot: that they must be of; None for any.
        architecture: key of ARCHITECTURES; None for any.
        left_out: a part that is not read.

    Raises:
        InvalidInputError: a file is missing or damaged (sha256), or a field is wrong.
        OtherRobotError: the weights are another robot's.
    """
    description = read_description(folder, architecture, robot)
    of, listed = description["architecture"], description["sha256"]
    require_choice(f"architecture in {Path(folder) / CONFIG_FILE}", of, ARCHITECTURES)
    sizes, (first, *others) = ARCHITECTURES[of]
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
    # read whole, so that the digest is of the very bytes that are used
    data = read_bytes(path, "weights")
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise InvalidInputError(
            f"{path} is damaged: sha256 {found[:12]}..., {CONFIG_FILE} says "
            f"{str(expected)[:12]}...; fetch it again"
        )
    try:
        return safetensors.numpy.load(data)
    # KeyError: a kind of number that numpy does not have
    except (SafetensorError, KeyError) as error:
        raise InvalidInputError(
            f"{path} is not a safetensors file that can be used: {error}"
        ) from error


def weights_digest(folder: Path) -> str:
    """One sha256 of ``config.json`` and of every file of tensors, with their names."""
    digest = hashlib.sha256()
    for path in (Path(folder) / CONFIG_FILE, *sorted(Path(folder).glob("*.safetensors"))):
        digest.update(
            f"{path.name} {hashlib.sha256(read_bytes(path, 'weights')).hexdigest()}\n".encode()
        )
    return digest.hexdigest()


def checkpoint_folder(folder: Path) -> Path | None:
    """This folder if it holds weights, or the ``model`` that a training left in it, or None."""
    for candidate in (Path(folder), Path(folder) / TRAINED_FOLDER):
        if (candidate / CONFIG_FILE).is_file():
            return candidate
    return None


def resolve_model(
    model: str | Path | None = None,
    architecture: str | None = None,
    robot: RobotSignature | None = None,
) -> Path:
    """Folder of a model's weights.

    Args:
        model: a name of `SHIPPED`, a folder of weights or of a training; None for the shipped ones.
        architecture: key of ARCHITECTURES; None for any.
        robot: that the weights must be of; None for any.

    Raises:
        InvalidInputError: there is no such model, or `read_description` refuses it.
    """
    names = [name for name, of in SHIPPED.items() if architecture in (None, of)]
    name = names[0] if model is None else str(model)
    folder = checkpoint_folder(WEIGHTS / name if name in SHIPPED else Path(name))
    if folder is None:
        raise InvalidInputError(
            f"no weights in {model or WEIGHTS / name}; give one of {', '.join(names)}, or the "
            "folder of a model that you trained (cvqmpt train) or imported (cvqmpt model import)"
        )
    read_description(folder, architecture, robot)
    return folder


@lru_cache(maxsize=8)
def _signature(model: str, kind: str) -> RobotSignature:
    return read_description(resolve_model(model, SHIPPED[kind]), SHIPPED[kind])["robot"]


def incompatibility(model: str, kind: str, robot: RobotSignature) -> str:
    """Why a model of a kind (a name of `SHIPPED`) does not fit a robot, or ""."""
    try:
        _signature(model, kind).require_same(robot)
    except OtherRobotError as error:
        return str(error)
    return ""


def robot_signature(robot: Any) -> RobotSignature:
    """Signature of a robot, with which weights are compared."""
    limits = tuple(robot.lower.tolist()), tuple(robot.upper.tolist())
    return RobotSignature(robot.name, *limits, tuple(robot.joint_names), robot.kinematics_digest)


def load_vq_mpt(robot: Any, model: str | Path | None = None) -> StoredModel:
    """VQ-MPT for a robot; `model` and errors as in `resolve_model`, and those of `read_model`."""
    signature = robot_signature(robot)
    return read_model(resolve_model(model, VQ_MPT, signature), signature, VQ_MPT)
