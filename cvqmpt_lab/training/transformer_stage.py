"""Training of the scene transformer, on what `roadmap_stage` says."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.training.roadmap_dataset import RoadmapDataset
from cvqmpt_lab.training.roadmap_stage import (
    Cloud,
    Predicted,
    RoadmapSettings,
    RoadmapStage,
    chosen,
)
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import SceneTransformerConfig, SceneTransformerSizes
from cvqmpt_lab.vqmpt.scene_arrays import group_points
from cvqmpt_lab.vqmpt.scene_transformer import Ends, SceneTransformer


class TransformerStage(RoadmapStage):
    """Training of a scene transformer."""

    module: SceneTransformer

    def __init__(
        self,
        dataset: RoadmapDataset,
        dictionary: Checkpoint,
        settings: RoadmapSettings,
        sizes: SceneTransformerSizes,
        seed: int,
        device: torch.device,
    ) -> None:
        super().__init__(dataset, dictionary, settings, sizes.links, seed, device)
        assert dataset.chain is not None
        graph = dataset.graph
        body = replace(
            dataset.chain, points=tuple(graph.body_joint.tolist()), offsets=graph.body_offset
        )
        self.config = SceneTransformerConfig(
            lower=dataset.robot.lower,
            upper=dataset.robot.upper,
            body=body,
            n_nodes=len(graph.nodes),
            n_edges=len(graph.edges),
            sizes=sizes,
        )
        self.module = SceneTransformer(self.config).to(device)
        self.module.set_roadmap(graph.nodes, graph.edges)

    def prepare(self) -> None:
        """Begin with how often each code and edge is free, or with the weights that are fine-tuned."""
        if self.settings.fine_tune:
            self._begin_with(self.dictionary.transformer)
            return
        with torch.no_grad():
            priors = (self.module.node_prior, self.module.edge_prior)
            for prior, share in zip(priors, self.free_shares(), strict=True):
                prior.copy_(share)

    def _begin_with(self, trained: SceneTransformer | None) -> None:
        if trained is None or trained.config.sizes != self.config.sizes:
            raise InvalidInputError(
                "fine_tune needs a --dictionary whose weights hold a transformer of the sizes of "
                "transformer_model; "
                "leave both out to begin with the shipped weights"
            )
        self.module.load_state_dict(trained.state_dict())

    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Centres (t, 3) and offsets (t, m, 3) [m] of groups of points."""
        sizes = self.config.sizes
        centres, offsets = group_points(points, sizes.groups, sizes.group_size)
        return {"centres": centres, "offsets": offsets}

    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> Predicted:
        """Logits over codes and goal, and what is free."""
        scenes = self.module.encode(cloud["centres"], cloud["offsets"])
        starts, goals = (self.module.ends(scenes, batch[name]) for name in ("starts", "goals"))
        V = self.module.cost_to_go(scenes, goals)
        start = Ends(*(chosen(part, batch["start"]) for part in starts))
        goal = Ends(*(chosen(part, batch["goal"]) for part in goals))
        logits = self.module.logits(scenes, start, goal, chosen(V, batch["goal"]), batch["codes"])
        links = self.module.link_odds(scenes, batch["link_end"], batch["link_code"])
        return Predicted(logits, scenes.node_odds, scenes.edge_odds, links)

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """The dictionary with the transformer as it stands."""
        config = replace(self.dictionary.config, transformer=self.config)
        return replace(self.dictionary, config=config, transformer=self.module, metadata=metadata)
