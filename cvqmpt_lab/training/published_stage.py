"""Training of the authors' sequence model on roadmap labels: what the scene transformer is compared
with.

It gets the same scenes, clouds, paths and validation. With the dense loss two heads, which only the
training has, predict P(code free) and P(edge free): every code has a query of its own that attends
to the scene tokens.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.training.roadmap_dataset import RoadmapDataset
from cvqmpt_lab.training.roadmap_stage import (
    Cloud,
    Predicted,
    RoadmapSettings,
    RoadmapStage,
    chosen,
)
from cvqmpt_lab.training.shards import LINKS
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import PointCloudConfig, SequenceConfig
from cvqmpt_lab.vqmpt.transformer import PublishedSequenceModel, Scene

EDGE_WIDTH = 64  # of the dense head


@dataclass(frozen=True, kw_only=True)
class PublishedSizes:
    """Sizes of the authors' sequence model, and whether it is trained with the dense loss;
    defaults as published.
    """

    point_cloud: PointCloudConfig = field(default_factory=PointCloudConfig)
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    dense: bool = False


class DenseHead(nn.Module):
    """P(code free) and P(edge free) from scene tokens."""

    edges: Tensor

    def __init__(self, n_nodes: int, edges: np.ndarray, width: int) -> None:
        super().__init__()
        self.register_buffer("edges", torch.from_numpy(edges.astype(np.int64)), persistent=False)
        self.query = nn.Parameter(0.02 * torch.randn(n_nodes, width))
        self.norm, self.key, self.value = (
            nn.LayerNorm(width),
            nn.Linear(width, width),
            nn.Linear(width, width),
        )
        self.node, self.node_prior = nn.Linear(width, 1), nn.Parameter(torch.zeros(n_nodes))
        self.part = nn.Linear(width, EDGE_WIDTH)
        self.own_edge = nn.Parameter(0.02 * torch.randn(len(edges), EDGE_WIDTH))
        self.edge, self.edge_prior = nn.Linear(EDGE_WIDTH, 1), nn.Parameter(torch.zeros(len(edges)))

    def forward(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Log odds (s, N) and (s, E) from scene tokens (s, m, width)."""
        seen = self.norm(tokens)
        query = self.query.to(seen.dtype).expand(len(tokens), -1, -1)
        codes = query + F.scaled_dot_product_attention(query, self.key(seen), self.value(seen))
        parts = self.part(codes).float()
        pairs = parts[:, self.edges[:, 0]] + parts[:, self.edges[:, 1]] + self.own_edge
        node = self.node(codes)[..., 0].float() + self.node_prior
        return node, self.edge(pairs.relu())[..., 0].float() + self.edge_prior


class PublishedStage(RoadmapStage):
    """Training of a model of the authors' architecture."""

    def __init__(
        self,
        dataset: RoadmapDataset,
        dictionary: Checkpoint,
        settings: RoadmapSettings,
        sizes: PublishedSizes,
        seed: int,
        device: torch.device,
    ) -> None:
        super().__init__(dataset, dictionary, settings, LINKS, seed, device)
        self.config = replace(
            dictionary.config,
            transformer=None,
            point_cloud=sizes.point_cloud,
            sequence=sizes.sequence,
        )
        self.dictionary.dictionary.to(device).requires_grad_(False)
        self.model = PublishedSequenceModel(self.config)
        nodes, width = len(dataset.graph.nodes), sizes.sequence.transformer.d_model
        self.dense = DenseHead(nodes, dataset.graph.edges, width) if sizes.dense else None
        self.module = nn.ModuleList(
            [self.model] if self.dense is None else [self.model, self.dense]
        )
        self.module.to(device)
        limits = torch.tensor([dataset.robot.lower, dataset.robot.upper], device=device)
        self._lower, self._range = limits[0], limits[1] - limits[0]

    def prepare(self) -> None:
        """Begin the dense head with how often each code and edge is free."""
        if self.dense is not None:
            with torch.no_grad():
                for prior, share in zip(
                    (self.dense.node_prior, self.dense.edge_prior), self.free_shares(), strict=True
                ):
                    prior.copy_(share)

    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """The points themselves."""
        return {"points": np.asarray(points, dtype=np.float32)}

    def validate(self) -> dict[str, float | None]:
        """The same, and the share of scene features that no cloud changes."""
        constant = self.model.context.env_encoder.constant_features()
        return super().validate() | {"constant_features": constant}

    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> Predicted:
        """Logits over codes, start token and goal; and what is free, with the dense loss."""
        scene = self.model.encode_scene(cloud["points"])
        logits = self._logits(scene, batch)
        return Predicted(logits, *([] if self.dense is None else self.dense(scene[0])))

    def _logits(self, scene: Scene, batch: dict[str, Tensor]) -> Tensor:
        """Logits (s, r, l + 1, N + 2): prefixes of one length are a batch, so that none is padded."""
        ends = [
            (chosen(batch[f"{end}s"], batch[end]) - self._lower) / self._range
            for end in ("start", "goal")
        ]
        context = self.model.encode_context(scene, *(end.flatten(0, 1) for end in ends))
        codes, count = batch["codes"].flatten(0, 1), batch["count"].flatten()
        steps, quantizer = [], self.dictionary.dictionary.quantizer
        for length in range(codes.shape[1] + 1):
            rows = (count >= length).nonzero()[:, 0]
            logits = self.model.prefix_logits(
                context[rows], codes[rows, :length], quantizer
            ).float()
            steps.append(logits.new_zeros(len(codes), logits.shape[-1]).index_copy(0, rows, logits))
        return torch.stack(steps, 1).unflatten(0, batch["count"].shape)

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """The dictionary with the sequence model as it stands."""
        return Checkpoint(
            self.config, self.dictionary.robot, self.dictionary.dictionary, self.model, metadata
        )
