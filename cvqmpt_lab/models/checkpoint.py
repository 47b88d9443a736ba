"""Trained models on disk: VQ-MPT (the dictionary, and the sequence model once there is one) and MPNet."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from torch import nn

from cvqmpt_lab.codec.plain import from_plain, to_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.models.compact.sequence_model import CompactSequenceModel
from cvqmpt_lab.models.config import ModelConfig
from cvqmpt_lab.models.dictionary.dictionary import Dictionary
from cvqmpt_lab.models.mpnet.network import MPNetCheckpoint, load_mpnet
from cvqmpt_lab.models.published.sequence_model import PublishedSequenceModel
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.models.weights_folder import CONFIG_FILE, load_part, read_description, write_weights

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
    """A VQ-MPT model and what it belongs to."""

    architecture: ClassVar[str] = "vq-mpt"

    config: ModelConfig
    robot: RobotSignature
    dictionary: Dictionary
    sequence_model: SequenceModel | None = None
    """None after stage 1 alone."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """Json values: how it was trained."""

    def __post_init__(self) -> None:
        if len(self.robot.lower) != self.config.joint_dim:
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


Trained = Checkpoint | MPNetCheckpoint
"""Whatever `save_checkpoint` writes."""


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
        checkpoint.parts,
    )


def load_checkpoint(folder: Path, robot: RobotSignature | None = None) -> Checkpoint:
    """Read a VQ-MPT checkpoint, its modules in evaluation mode on the CPU.

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
        that does not fit.
    OtherRobotError
        Naming the differences between the robots.
    """
    description = read_description(folder, Checkpoint.architecture, robot)
    config = from_plain(ModelConfig, description.model, "model", complete=True)
    dictionary = load_part(folder, description, "dictionary", lambda: Dictionary(config))
    sequence_model = None
    if "sequence_model" in description.sha256:
        sequence_model = load_part(
            folder, description, "sequence_model", lambda: build_sequence_model(config)
        )
    return Checkpoint(config, description.robot, dictionary, sequence_model, description.metadata)


_LOADERS: dict[str, Callable[[Path, RobotSignature | None], Trained]] = {
    Checkpoint.architecture: load_checkpoint,
    MPNetCheckpoint.architecture: load_mpnet,
}


def load_any(folder: Path) -> Trained:
    """Read a checkpoint of whatever architecture its folder names; errors as in `load_checkpoint`."""
    architecture = read_description(folder).architecture
    if architecture not in _LOADERS:
        raise UnknownChoiceError(f"architecture in {Path(folder) / CONFIG_FILE}", architecture, _LOADERS)
    return _LOADERS[architecture](folder, None)
