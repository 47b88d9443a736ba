"""Named trainings: model and settings of every stage; profiles.toml has their numbers."""

import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.training.dataset import PathDataset, open_dataset, open_labels
from cvqmpt_lab.training.dictionary_stage import DictionaryStage, Stage1Settings
from cvqmpt_lab.training.mpnet_stage import MPNetSettings, MPNetStage
from cvqmpt_lab.training.sequence_networks import (
    PublishedSizes,
    PublishedStage,
    TransformerStage,
    open_sequences,
)
from cvqmpt_lab.training.sequence_stage import RoadmapSettings
from cvqmpt_lab.training.stage import Stage
from cvqmpt_lab.vqmpt import config as sizes
from cvqmpt_lab.vqmpt.checkpoint import load_checkpoint
from cvqmpt_lab.vqmpt.weights import VQ_MPT, resolve_model

MODELS = {
    "stage1": "model",
    "mpnet": "mpnet_model",
    "transformer": "transformer_model",
    "published": "published_model",
}
"""What each stage trains."""


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Models and settings of all stages."""

    name: str
    link_features: bool  # the model takes link positions, as many as the dataset's kinematics give
    model: sizes.ModelConfig  # joints and features are the dataset's, see `model_for`
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
        """The model for a dataset: its joints and features, for which it must have kinematics."""
        if self.link_features and dataset.chain is None:
            raise InvalidInputError(
                f"profile {self.name!r} takes link positions, but {dataset.folder} has no "
                "kinematics; set link_features to false"
            )
        feature_dim = dataset.chain.feature_dim if self.link_features and dataset.chain else 0
        return replace(self.model, joint_dim=len(dataset.robot.lower), feature_dim=feature_dim)

    def stage(
        self, name: str, data: Path, dictionary: Path | None, seed: int, device: torch.device
    ) -> Stage:
        """A stage, ready to be trained on a folder of data.

        Args:
            name: of `MODELS`.
            data: folder of the dataset.
            dictionary: folder of a training of stage 1, for sequence models.
            seed: of all that is drawn.
            device: to train on.

        InvalidInputError or UnknownChoiceError: no such stage, or data, dictionary and model do not
        fit each other.
        """
        require_choice("stage", name, MODELS)
        if name in ("stage1", "mpnet"):
            if dictionary is not None:
                raise InvalidInputError(f"{name} takes no dictionary; leave it out")
            paths = open_dataset(data)
            if name == "stage1":
                model = self.model_for(paths)
                return DictionaryStage(paths, model, self.stage1, seed, device)
            network = replace(self.mpnet_model, joint_dim=len(paths.robot.lower))
            return MPNetStage(paths, network, self.mpnet, seed, device)
        words = load_checkpoint(resolve_model(dictionary, VQ_MPT))
        if name == "transformer":
            labels, network_sizes = open_labels(data), self.transformer_model
            return TransformerStage(labels, words, self.transformer, network_sizes, seed, device)
        sequences, published_sizes = open_sequences(data, words), self.published_model
        return PublishedStage(sequences, words, self.published, published_sizes, seed, device)


def _profiles() -> dict[str, Profile]:
    """The profiles of profiles.toml by name."""
    file = (Path(__file__).parent / "profiles.toml").read_text(encoding="utf-8")
    found = {}
    for name, plain in tomllib.loads(file).items():
        # toml has no null: a compact model is a dictionary alone
        if plain["model"].get("kind") == "compact":
            plain["model"] |= {"point_cloud": None, "sequence": None}
        found[name] = from_plain(Profile, {"name": name, **plain}, f"profile {name}")
    return found


PROFILES = _profiles()


def profile_named(name: str) -> Profile:
    """A profile; raises UnknownChoiceError."""
    return PROFILES[require_choice("profile", name, PROFILES)]
