"""Trained weights as plain arrays, read from a folder without torch: what planning works with."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.codec.plain import from_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.models.config import ModelConfig, MPNetConfig
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.models.weights_folder import CONFIG_FILE, read_description, read_part

VQ_MPT, MPNET = "vq-mpt", "mpnet"
CONFIGS: dict[str, type[ModelConfig] | type[MPNetConfig]] = {VQ_MPT: ModelConfig, MPNET: MPNetConfig}
"""Sizes and options of each architecture."""
PARTS = {VQ_MPT: ("dictionary", "sequence_model", "sight", "sequences"), MPNET: ("mpnet",)}
"""Files of each architecture; the first is always there, VQ-MPT's second after stage 2 (kind "published" alone), its
third if it has eyes, its fourth if these show it sequences of codes."""

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
