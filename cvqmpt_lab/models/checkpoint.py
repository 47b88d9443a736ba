"""A trained VQ-MPT model on disk: the dictionary, and the sequence model once there is one."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import nn

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.compact.sequence_model import CompactSequenceModel
from cvqmpt_lab.models.config import ModelConfig
from cvqmpt_lab.models.dictionary.dictionary import Dictionary
from cvqmpt_lab.models.published.sequence_model import PublishedSequenceModel
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.models.weights_folder import load_part, read_description, write_weights

ARCHITECTURE = "vq-mpt"
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
    model = checkpoint.config.to_json()
    write_weights(folder, ARCHITECTURE, model, checkpoint.robot, checkpoint.metadata, checkpoint.parts)


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
    description = read_description(folder, ARCHITECTURE, robot)
    config = ModelConfig.from_json(description.model)
    dictionary = Dictionary(config)
    load_part(folder, description, "dictionary", dictionary)
    sequence_model = None
    if "sequence_model" in description.sha256:
        sequence_model = build_sequence_model(config).eval()
        load_part(folder, description, "sequence_model", sequence_model)
    return Checkpoint(config, description.robot, dictionary.eval(), sequence_model, description.metadata)
