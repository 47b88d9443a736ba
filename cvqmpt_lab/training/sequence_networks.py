"""Training of the two sequence models: scene transformer, and the authors' architecture.

Both are trained and validated on the same scenes, clouds and sequences (`sequence_stage`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.training.sequence_dataset import SequenceDataset
from cvqmpt_lab.training.sequence_stage import Cloud, RoadmapSettings, SequenceStage, chosen
from cvqmpt_lab.training.shards import LINKS_PER_END
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import (
    PointCloudConfig,
    SceneTransformerConfig,
    SceneTransformerSizes,
    SequenceConfig,
)
from cvqmpt_lab.vqmpt.published_network import (
    PublishedSequenceModel,
    centre_count,
    farthest_points,
)
from cvqmpt_lab.vqmpt.scene_transformer import SceneTransformer
from cvqmpt_lab.vqmpt.transformer_inputs import Ends, group_points


class TransformerStage(SequenceStage):
    """Training of a scene transformer."""

    def __init__(
        self,
        dataset: SequenceDataset,
        dictionary: Checkpoint,
        settings: RoadmapSettings,
        sizes: SceneTransformerSizes,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on labels of a roadmap; arguments and errors as of `SequenceStage`."""
        longest = SceneTransformerConfig.max_codes
        super().__init__(dataset, dictionary, settings, sizes.links, longest, seed, device)
        assert dataset.chain is not None and dataset.graph is not None
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
        self.model = SceneTransformer(self.config).to(device)
        self.model.set_roadmap(graph.nodes, graph.edges)

    def prepare(self) -> None:
        """Set priors to the frequency of free nodes and edges, or load weights to fine-tune."""
        if not self.settings.fine_tune:
            rows = self._train[:: max(1, len(self._train) // 2000)]
            with torch.no_grad():
                for name in ("node", "edge"):
                    share = torch.from_numpy(self.dataset.free(name, rows).mean(axis=0)).float()
                    prior = getattr(self.model, f"{name}_prior")
                    prior.copy_(torch.logit(share.clamp(0.01, 0.99)))  # log(p / (1 - p))
            return
        trained = self.dictionary.modules.get("transformer")
        if trained is None or trained.config.sizes != self.config.sizes:
            raise InvalidInputError(
                "fine_tune needs a --dictionary whose weights hold a transformer of the sizes of "
                "transformer_model; leave both out to start from the shipped weights"
            )
        self.model.load_state_dict(trained.state_dict())

    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Return centres (t, 3) and offsets (t, m, 3) [m] of groups of points."""
        sizes = self.config.sizes
        centres, offsets = group_points(points, sizes.groups, sizes.group_size)
        return {"centres": centres, "offsets": offsets}

    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Compute logits of codes and goal, and log odds that nodes, edges and links are free."""
        scenes = self.model.encode(cloud["centres"], cloud["offsets"])
        starts, goals = (self.model.ends(scenes, batch[name]) for name in ("starts", "goals"))
        V = self.model.cost_to_go(scenes, goals)
        start = Ends(*(chosen(part, batch["start"]) for part in starts))
        goal = Ends(*(chosen(part, batch["goal"]) for part in goals))
        logits = self.model.logits(scenes, start, goal, chosen(V, batch["goal"]), batch["codes"])
        links = self.model.link_odds(scenes, batch["link_end"], batch["link_code"])
        return {"code": logits, "node": scenes.node_odds, "edge": scenes.edge_odds, "link": links}

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """Return the dictionary and the transformer with their present weights."""
        config = replace(self.dictionary.config, transformer=self.config)
        modules = {**self.dictionary.modules, "transformer": self.model}
        return Checkpoint(config, self.dictionary.robot, modules, metadata)


@dataclass(frozen=True, kw_only=True)
class PublishedSizes:
    """Sizes of the authors' sequence model, by default as published."""

    point_cloud: PointCloudConfig = field(default_factory=PointCloudConfig)
    sequence: SequenceConfig = field(default_factory=SequenceConfig)


class PublishedStage(SequenceStage):
    """Training of the authors' architecture, on labels of a roadmap or on encoded paths."""

    def __init__(
        self,
        dataset: SequenceDataset,
        dictionary: Checkpoint,
        settings: RoadmapSettings,
        sizes: PublishedSizes,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on sequences; arguments and errors as of `SequenceStage`."""
        longest = sizes.sequence.max_length - 1
        if dataset.graph is not None:
            longest = SceneTransformerConfig.max_codes
        super().__init__(dataset, dictionary, settings, LINKS_PER_END, longest, seed, device)
        self.config = replace(
            dictionary.config,
            transformer=None,
            point_cloud=sizes.point_cloud,
            sequence=sizes.sequence,
        )
        dictionary.modules["dictionary"].to(device).requires_grad_(False)
        self.model = PublishedSequenceModel(self.config)
        self.to(device)
        limits = torch.tensor([dataset.robot.lower, dataset.robot.upper], device=device)
        self._lower, self._range = limits[0], limits[1] - limits[0]

    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Return the cloud's points and the order of its farthest ones.

        The order is computed here, in a process that loads data, because a GPU is slow at it.
        """
        points = np.asarray(points, dtype=np.float32)
        point_cloud, _ = self.config.stage2
        count = centre_count(point_cloud.sa1, len(points))
        return {"points": points, "order": farthest_points(points, count)}

    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Compute logits (s, r, l + 1, N + 2) of codes, start token and goal token.

        All prefixes of equal length are one batch, since the model has no mask for padding.
        """
        scene = self.model.encode_scene(cloud["points"], cloud["order"])
        ends = [
            (chosen(batch[f"{end}s"], batch[end]) - self._lower) / self._range
            for end in ("start", "goal")
        ]
        context = self.model.encode_context(scene, *(end.flatten(0, 1) for end in ends))
        codes, count = batch["codes"].flatten(0, 1), batch["count"].flatten()
        steps, quantizer = [], self.dictionary.modules["dictionary"].quantizer
        for length in range(codes.shape[1] + 1):
            rows = (count >= length).nonzero()[:, 0]
            prefixes = context[rows], codes[rows, :length]
            logits = self.model.prefix_logits(*prefixes, quantizer).float()
            steps.append(logits.new_zeros(len(codes), logits.shape[-1]).index_copy(0, rows, logits))
        return {"code": torch.stack(steps, 1).unflatten(0, batch["count"].shape)}

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """Return the dictionary and the sequence model with their present weights."""
        modules = {
            "dictionary": self.dictionary.modules["dictionary"],
            "sequence_model": self.model,
        }
        return Checkpoint(self.config, self.dictionary.robot, modules, metadata)
