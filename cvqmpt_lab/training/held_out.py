"""What a training's validation says of a trained sequence model, in any scenes with labels."""

import numpy as np
import torch

from cvqmpt_lab.training.published_stage import PublishedSizes, PublishedStage
from cvqmpt_lab.training.roadmap_dataset import RoadmapDataset
from cvqmpt_lab.training.roadmap_stage import RoadmapSettings
from cvqmpt_lab.training.transformer_stage import TransformerStage
from cvqmpt_lab.vqmpt.checkpoint import as_modules
from cvqmpt_lab.vqmpt.weights import StoredModel


@torch.no_grad()
def held_out_values(
    stored: StoredModel, labels: RoadmapDataset, other: np.ndarray, paths: int
) -> dict[str, float | None]:
    """Cross entropies, and areas under curves, named as in a training's curves, over all scenes of
    labels.

    other (m, 3): cloud of another scene [m]. paths: of each scene. InvalidInputError: the model has
    no sequence model.
    """
    settings, cpu = RoadmapSettings(scenes=1, paths=paths), torch.device("cpu")
    checkpoint = as_modules(stored)
    stage: TransformerStage | PublishedStage
    if checkpoint.transformer is not None:
        stage = TransformerStage(
            labels, checkpoint, settings, checkpoint.transformer.config.sizes, 0, cpu
        )
        stage.module.load_state_dict(checkpoint.transformer.state_dict())
    else:
        stored.require_part("sequence_model")
        assert checkpoint.sequence_model is not None
        point_cloud, sequence = stored.config.stage2
        sizes = PublishedSizes(point_cloud=point_cloud, sequence=sequence)
        stage = PublishedStage(labels, checkpoint, settings, sizes, 0, cpu)
        stage.model.load_state_dict(checkpoint.sequence_model.state_dict())
    stage.module.eval()
    return stage.measured(np.unique(labels.path_scene), other)
