"""Named trainings as plain tables: model and settings of every stage."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.training.clouds import CloudSettings, CropSettings
from cvqmpt_lab.training.dataset import PathDataset, open_dataset, open_labels
from cvqmpt_lab.training.dictionary_stage import DictionaryStage, Stage1Settings
from cvqmpt_lab.training.mpnet_stage import MPNetSettings, MPNetStage, SceneBatchSettings
from cvqmpt_lab.training.sequence_networks import (
    PublishedSizes,
    PublishedStage,
    TransformerStage,
    open_sequences,
)
from cvqmpt_lab.training.sequence_stage import RoadmapSettings
from cvqmpt_lab.training.stage import OptimizerSettings, Stage
from cvqmpt_lab.vqmpt import config as sizes
from cvqmpt_lab.vqmpt.checkpoint import load_checkpoint
from cvqmpt_lab.vqmpt.scene_arrays import LONGEST
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
        if name not in MODELS:
            raise UnknownChoiceError("stage", name, MODELS)
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


def _compact() -> Profile:
    """The dictionary and MPNet that ship."""
    cloud = CloudSettings(points=1024)
    batches = SceneBatchSettings(
        scenes=12, paths_per_scene=8, spacing=0.2, turn_base=True, cloud=cloud
    )
    labels = RoadmapSettings()
    # About as many numbers as the scene transformer: at the authors' width of 512 a core takes an
    # eighth as many sequences a second. Twice the scene tokens.
    narrow = sizes.TransformerConfig(n_heads=3, d_k=64, d_v=64, d_model=192, d_inner=384)
    return Profile(
        name="compact",
        link_features=True,
        model=sizes.ModelConfig.compact(feature_dim=3, n_codes=1024),
        mpnet_model=sizes.MPNetConfig(
            n_points=1024, planner_widths=(896, 512, 384, 256, 128, 64), dropout=0.3
        ),
        stage1=Stage1Settings(
            epochs=10,
            batch=64,
            row=32,
            spacing=0.2,
            turn_base=True,
            restart_epochs=7,
            optimizer=OptimizerSettings(rate=2e-3, schedule="cosine", clip=1000.0),
        ),
        mpnet=MPNetSettings(
            epochs=10,
            # clouds have n_points points, too
            batches=replace(batches, spacing=0.5, batches_per_epoch=300),
            optimizer=OptimizerSettings(rate=5e-4, schedule="cosine", epsilon=1e-8, clip=1.0),
        ),
        published_model=PublishedSizes(
            point_cloud=sizes.PointCloudConfig(
                sa1=sizes.SetAbstractionConfig(
                    ratio=0.5, radius=0.2, max_neighbours=32, widths=(32, 64)
                ),
                sa2=sizes.SetAbstractionConfig(
                    ratio=0.5, radius=0.4, max_neighbours=32, widths=(128, 192)
                ),
            ),
            sequence=sizes.SequenceConfig(
                context=narrow, transformer=narrow, max_length=LONGEST + 1
            ),
            dense=True,
        ),
        # The authors' highest rate; at 5e-4 the ReLU of 188 of 192 scene features was always 0.
        published=replace(labels, optimizer=replace(labels.optimizer, rate=1.35e-4, warmup=400)),
    )


def _smoke() -> Profile:
    """The published architecture, small: all stages run in minutes, to show that they run."""
    small = sizes.TransformerConfig(
        n_layers=2, n_heads=2, d_k=16, d_v=16, d_model=48, d_inner=96, dropout=0.1
    )
    points = sizes.PointCloudConfig(
        sa1=sizes.SetAbstractionConfig(ratio=0.25, radius=0.25, max_neighbours=8, widths=(16, 32)),
        sa2=sizes.SetAbstractionConfig(ratio=0.25, radius=0.6, max_neighbours=16, widths=(48, 48)),
    )
    cloud = CloudSettings(points=256)
    batches = SceneBatchSettings(
        scenes=8,
        paths_per_scene=4,
        batches_per_epoch=40,
        spacing=0.2,
        turn_base=True,
        cloud=cloud,
        validation_paths=64,
    )
    quick = OptimizerSettings(rate=2e-3, warmup=20, schedule="cosine", clip=50.0)
    few = RoadmapSettings(
        epochs=2,
        batches_per_epoch=30,
        scenes=2,
        paths=24,
        goals=6,
        cloud=cloud,
        validation_scenes=4,
        precision="float32",
        optimizer=quick,
    )
    return Profile(
        name="smoke",
        link_features=False,
        model=sizes.ModelConfig(
            dictionary=sizes.DictionaryConfig(transformer=small, n_codes=128, decoder_dropout=0.0),
            point_cloud=points,
            sequence=sizes.SequenceConfig(context=small, transformer=small),
        ),
        mpnet_model=sizes.MPNetConfig(
            n_points=256,
            encoder_widths=(128, 64),
            code_dim=28,
            planner_widths=(256, 128, 64),
            dropout=0.2,
        ),
        stage1=Stage1Settings(
            epochs=3,
            batch=16,
            spacing=0.2,
            batches_per_epoch=100,
            turn_base=True,
            validation_paths=100,
            optimizer=quick,
        ),
        mpnet=replace(_compact().mpnet, epochs=3, batches=replace(batches, spacing=0.5)),
        transformer_model=sizes.SceneTransformerSizes(
            width=32, layers=2, heads=2, groups=32, group_size=8, values=4, edge_width=16, links=12
        ),
        transformer=few,
        published_model=PublishedSizes(
            point_cloud=points, sequence=sizes.SequenceConfig(context=small, transformer=small)
        ),
        published=few,
    )


def _published() -> Profile:
    """Architecture, losses and schedules of the paper, which gives no batch sizes and epochs."""
    crop = CropSettings(kind="box")
    cloud = CloudSettings(points=2048, crop=crop, noise=0.0, occlusion=1.0, density=0.0)
    batches = SceneBatchSettings(scenes=16, paths_per_scene=2, cloud=cloud)
    warmed = OptimizerSettings(rate=0.15 * 512**-0.5 * 2400**-0.5, warmup=2400)
    return Profile(
        name="published",
        link_features=False,
        model=sizes.ModelConfig(),
        mpnet_model=sizes.MPNetConfig(),
        stage1=Stage1Settings(
            epochs=50,
            batch=64,
            optimizer=OptimizerSettings(rate=0.2 * 512**-0.5 * 20000**-0.5, warmup=20000),
        ),
        published=RoadmapSettings(cloud=cloud, optimizer=warmed),
        mpnet=MPNetSettings(
            epochs=200,
            batches=replace(batches, spacing=0.5, cloud=replace(cloud, points=4120)),
            optimizer=OptimizerSettings(kind="adagrad", rate=1e-3, warmup=1, schedule="constant"),
        ),
    )


PROFILES = {profile.name: profile for profile in (_smoke(), _compact(), _published())}


def profile_named(name: str) -> Profile:
    """A profile; raises UnknownChoiceError."""
    if name not in PROFILES:
        raise UnknownChoiceError("profile", name, PROFILES)
    return PROFILES[name]
