"""Which robot weights were trained for: what is kept beside them, and compared with the robot at hand."""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

import cvqmpt_lab
from cvqmpt_lab.codec.plain import from_plain, to_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import read_bytes, read_json_object, require_regular_file, write_bytes
from cvqmpt_lab.vqmpt.config import ModelConfig, MPNetConfig

LIMIT_TOLERANCE = 1e-4
"""Joint limits that differ by less are the same robot's [rad or m]."""


class OtherRobotError(InvalidInputError):
    """Weights of one robot were about to be used for another."""

    def __init__(self, weights: "RobotSignature", robot: "RobotSignature", differences: list[str]) -> None:
        name = "this one" if weights.name == robot.name else repr(robot.name)
        super().__init__(
            f"weights are for robot {weights.name!r}, not {name}: {'; '.join(differences)}; "
            "choose weights trained for it"
        )
        self.weights = weights
        self.robot = robot
        self.differences = differences


@dataclass(frozen=True)
class RobotSignature:
    """A robot as weights remember it. Where a digest is known, names of robots are labels only."""

    name: str
    lower: tuple[float, ...]
    """(n,), by which joints are scaled [rad or m]."""
    upper: tuple[float, ...]
    """(n,) [rad or m]."""
    joints: tuple[str, ...] = ()
    """(n,) names; empty where an earlier version did not record them."""
    kinematics: str = ""
    """`Robot.kinematics_digest`; likewise."""

    def __post_init__(self) -> None:
        if (
            not self.lower
            or len(self.lower) != len(self.upper)
            or not all(map(float.__lt__, self.lower, self.upper))
        ):
            raise InvalidInputError(f"lower {self.lower} and upper {self.upper} are no joint limits")
        if self.joints and len(self.joints) != len(self.lower):
            raise InvalidInputError(f"{len(self.joints)} names of joints, but {len(self.lower)} limits")

    def require_same(self, other: "RobotSignature") -> None:
        """Compare with the robot at hand.

        Raises
        ------
        OtherRobotError
            Naming the differences.
        """
        differences = self.differences(other)
        if differences:
            raise OtherRobotError(self, other, differences)

    def differences(self, other: "RobotSignature") -> list[str]:
        """How `other` differs, in words, nothing when it is this robot."""
        if len(self.lower) != len(other.lower):
            return [f"{len(self.lower)} joints, not {len(other.lower)}"]
        if self.joints and other.joints and self.joints != other.joints:
            ours, theirs = next(
                pair for pair in zip(self.joints, other.joints, strict=True) if len(set(pair)) > 1
            )
            return [f"joint {ours!r}, not {theirs!r}"]
        limits = [
            f"{side} limit of joint {joint} {ours:g}, not {theirs:g}"
            for side in ("lower", "upper")
            for joint, (ours, theirs) in enumerate(
                zip(getattr(self, side), getattr(other, side), strict=True)
            )
            if not abs(ours - theirs) <= LIMIT_TOLERANCE
        ]
        if limits:
            return limits[:2]
        if not (self.kinematics and other.kinematics):
            return [] if self.name == other.name else ["another name, and no digest to compare"]
        if self.kinematics == other.kinematics:
            return []
        return [f"joints placed otherwise (kinematics {self.kinematics[:8]}, not {other.kinematics[:8]})"]


# Weights on disk: a folder of ``config.json`` and safetensors files, one for each part of a model.
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


# Trained weights as plain arrays, read from a folder without torch: what planning works with.
VQ_MPT, MPNET = "vq-mpt", "mpnet"
CONFIGS: dict[str, type[ModelConfig] | type[MPNetConfig]] = {VQ_MPT: ModelConfig, MPNET: MPNetConfig}
"""Sizes and options of each architecture."""
PARTS = {VQ_MPT: ("dictionary", "sequence_model", "sight"), MPNET: ("mpnet",)}
"""Files of each architecture; the first is always there, VQ-MPT's second after stage 2 (kind "published" alone), its
third if it has eyes."""

Arrays = Mapping[str, np.ndarray]
"""Weights by name."""


@dataclass(frozen=True, eq=False)
class StoredModel:
    """A trained model, whole, as plain data."""

    architecture: str
    """Key of `CONFIGS`."""
    config: Any
    """Of the type that `CONFIGS` says."""
    robot: RobotSignature
    parts: Mapping[str, Arrays]
    """By their names in `PARTS`."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """Json values: how it was trained."""

    def __post_init__(self) -> None:
        limits, joints = len(self.robot.lower), self.config.joint_dim
        if limits != joints:
            raise InvalidInputError(
                f"robot {self.robot.name!r} has limits of {limits} joints, the model {joints} joints"
            )

    def part(self, name: str) -> "Tensors":
        """The weights of a part, to be handed out.

        Raises
        ------
        InvalidInputError
            When the model has none: a published one was trained for stage 1 alone, or the kind has none.
        """
        if name not in self.parts:
            raise InvalidInputError(
                f"the model has no {name}, only {', '.join(self.parts)}; train stage2 of kind 'published' for one"
            )
        return Tensors(self.parts[name], name)


@dataclass(frozen=True, eq=False)
class Tensors:
    """Arrays that are handed out by name, each only in the shape that the configuration asks for."""

    arrays: Arrays
    where: str
    prefix: str = ""
    taken: set[str] = field(default_factory=set)

    def under(self, name: str) -> "Tensors":
        """Those whose names begin so; the rest of the name is asked for."""
        return replace(self, prefix=f"{self.prefix}{name}.")

    def __call__(self, name: str, *shape: int) -> np.ndarray:
        """An array of that shape, float64 for folding; raises InvalidInputError when it does not fit."""
        name = self.prefix + name
        array = self.arrays.get(name)
        if array is None:
            fault = "is missing"
        elif array.shape != shape:
            fault = f"is {array.shape}, expected {shape}"
        elif array.dtype.kind != "f":
            fault = f"is {array.dtype}, expected float32"
        elif not np.isfinite(array).all():
            fault = "has NaN or infinite values"
        else:
            self.taken.add(name)
            return array.astype(np.float64)
        raise InvalidInputError(f"{self.where} does not fit its configuration: {name} {fault}")

    def require_used(self) -> None:
        """Raise InvalidInputError when arrays were never asked for."""
        left = [name for name in self.arrays if name not in self.taken]
        if left:
            raise InvalidInputError(f"{self.where} does not fit its configuration: {left[0]} is left over")


def read_model(
    folder: Path, robot: RobotSignature | None = None, architecture: str | None = None
) -> StoredModel:
    """Read a folder of weights.

    Parameters
    ----------
    folder
        What `checkpoint.save_checkpoint` wrote.
    robot
        The robot at hand; the weights must belong to it. None to skip the comparison.
    architecture
        What it must be; None for any.

    Raises
    ------
    InvalidInputError
        Naming the file that is missing or damaged (sha256), or the field of ``config.json``.
    OtherRobotError
        Naming the differences between the robots.
    """
    description = read_description(folder, architecture, robot)
    of = description.architecture
    if of not in CONFIGS:
        raise UnknownChoiceError(f"architecture in {Path(folder) / CONFIG_FILE}", of, CONFIGS)
    config = from_plain(CONFIGS[of], description.model, "model", complete=True)
    first, *others = PARTS[of]
    names = [first, *(name for name in others if name in description.sha256)]
    parts = {name: read_part(folder, description, name) for name in names}
    return StoredModel(of, config, description.robot, parts, description.metadata)


# Where weights are: the one place that finds them by name or folder, for one robot.
WEIGHTS = Path(cvqmpt_lab.__file__).parent / "weights"
SHIPPED = {"vq_mpt": VQ_MPT, "mpnet": MPNET}
"""Names of the weights that come with the package, and their architectures; the first of each is the default."""


def resolve_model(
    model: str | Path | None = None, architecture: str | None = None, robot: RobotSignature | None = None
) -> Path:
    """Folder of a model's weights.

    Parameters
    ----------
    model
        A name of `SHIPPED`, a folder of weights, or that of a training, whose ``model`` is meant; None for
        the shipped ones.
    architecture
        What it must be; None for any.
    robot
        Whom it must belong to; None for any.

    Raises
    ------
    InvalidInputError
        When there is no such model, or one of another architecture.
    OtherRobotError
        When its weights belong to another robot.
    """
    names = [name for name, of in SHIPPED.items() if architecture in (None, of)]
    name = names[0] if model is None else str(model)
    folder = checkpoint_folder(WEIGHTS / name if name in SHIPPED else Path(name))
    if folder is None:
        raise InvalidInputError(
            f"no weights in {model or WEIGHTS / name}; give one of {', '.join(names)}, or the folder of a model "
            "that you trained (cvqmpt train) or imported (cvqmpt model import)"
        )
    read_description(folder, architecture, robot)
    return folder


@lru_cache(maxsize=8)
def _signature(model: str, kind: str) -> RobotSignature:
    return read_description(resolve_model(model, SHIPPED[kind]), SHIPPED[kind]).robot


def incompatibility(model: str, kind: str, robot: RobotSignature) -> str:
    """Why the weights of a model (see `resolve_model`) cannot serve a robot, or ""; kind: a name of `SHIPPED`."""
    try:
        _signature(model, kind).require_same(robot)
    except OtherRobotError as error:
        return str(error)
    return ""
