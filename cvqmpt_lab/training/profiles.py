"""Profiles of trainings: model and settings of every stage, read from profiles.toml."""

import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.training.dataset import PathDataset, open_dataset
from cvqmpt_lab.training.dictionary_stage import DictionaryStage, Stage1Settings
from cvqmpt_lab.training.mpnet_stage import MPNetSettings, MPNetStage
from cvqmpt_lab.training.sequence_dataset import open_labels, open_sequences
from cvqmpt_lab.training.sequence_networks import (
    PublishedSizes,
    PublishedStage,
    TransformerStage,
)
from cvqmpt_lab.training.sequence_stage import RoadmapSettings
from cvqmpt_lab.training.stage import Stage
from cvqmpt_lab.vqmpt import config as sizes
from cvqmpt_lab.vqmpt.checkpoint import load_checkpoint
from cvqmpt_lab.vqmpt.weights import VQ_MPT, resolve_model

STAGE_MODELS = {
    "stage1": "model",
    "mpnet": "mpnet_model",
    "transformer": "transformer_model",
    "published": "published_model",
}
"""Stages, and the field of `Profile` with the sizes of the model that each trains."""


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Models and settings of all stages."""

    name: str
    link_features: bool  # whether link positions are inputs of the dictionary's encoder
    model: sizes.ModelConfig  # numbers of joints and features are replaced by `model_for`
    mpnet_model: sizes.MPNetConfig
    stage1: Stage1Settings
    mpnet: MPNetSettings
    transformer_model: sizes.SceneTransformerSizes = field(
        default_factory=sizes.SceneTransformerSizes
    )
    transformer: RoadmapSettings = field(default_factory=RoadmapSettings)
    published_model: PublishedSizes = field(default_factory=PublishedSizes)
    published: RoadmapSettings = field(default_factory=RoadmapSettings)

    def __post_init__(self) -> None:
        if self.mpnet.batches.cloud.points != self.mpnet_model.n_points:
            raise InvalidInputError("mpnet.batches.cloud.points must equal mpnet_model.n_points")

    def model_for(self, dataset: PathDataset) -> sizes.ModelConfig:
        """Return the model's configuration with the numbers of joints and features of a dataset.

        Raises:
            InvalidInputError: link positions are inputs, but the dataset has no kinematics.
        """
        feature_dim = 0
        if self.link_features:
            if dataset.chain is None:
                raise InvalidInputError(
                    f"profile {self.name!r} takes link positions, but {dataset.folder} has no "
                    "kinematics; set link_features to false"
                )
            feature_dim = dataset.chain.feature_dim
        return replace(self.model, joint_dim=len(dataset.robot.lower), feature_dim=feature_dim)

    def stage(
        self, name: str, data: Path, dictionary: Path | None, seed: int, device: torch.device
    ) -> Stage:
        """Prepare a stage to be trained on a folder of data.

        Args:
            name: name of the stage, a key of `STAGE_MODELS`.
            data: folder of the dataset.
            dictionary: folder of a training of stage 1, for sequence models.
            seed: seed of all random numbers.
            device: device to train on.

        Raises:
            UnknownChoiceError: there is no such stage.
            InvalidInputError: data, dictionary and model do not fit each other.
        """
        require_choice("stage", name, STAGE_MODELS)
        if name in ("stage1", "mpnet"):
            if dictionary is not None:
                raise InvalidInputError(f"{name} takes no dictionary; leave it out")
            paths = open_dataset(data)
            if name == "stage1":
                model = self.model_for(paths)
                return DictionaryStage(paths, model, self.stage1, seed, device)
            network = replace(self.mpnet_model, joint_dim=len(paths.robot.lower))
            return MPNetStage(paths, network, self.mpnet, seed, device)
        stage1 = load_checkpoint(resolve_model(dictionary, VQ_MPT))
        if name == "transformer":
            labels = open_labels(data)
            return TransformerStage(
                labels, stage1, self.transformer, self.transformer_model, seed, device
            )
        sequences = open_sequences(data, stage1)
        return PublishedStage(sequences, stage1, self.published, self.published_model, seed, device)


def _profiles() -> dict[str, Profile]:
    """Read the profiles of profiles.toml, by name."""
    file = (Path(__file__).parent / "profiles.toml").read_text(encoding="utf-8")
    profiles = {}
    for name, plain in tomllib.loads(file).items():
        # compact profile: dictionary only (TOML has no null)
        if plain["model"].get("kind") == "compact":
            plain["model"] |= {"point_cloud": None, "sequence": None}
        profiles[name] = from_plain(Profile, {"name": name, **plain}, f"profile {name}")
    return profiles


PROFILES = _profiles()


def profile_named(name: str) -> Profile:
    """Return a profile by name; UnknownChoiceError if there is none."""
    return PROFILES[require_choice("profile", name, PROFILES)]
