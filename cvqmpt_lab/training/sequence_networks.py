"""The two sequence models that `sequence_stage` trains: scene transformer, authors' architecture.

Both get the same scenes, clouds, sequences and validation. With the dense loss two heads, which
only the training has, predict P(code free) and P(edge free) beside the authors' network: every code
has a query of its own that attends to the scene tokens.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.training.batches import RoadmapSettings
from cvqmpt_lab.training.dataset import SequenceDataset
from cvqmpt_lab.training.sequence_stage import Cloud, Predicted, SequenceStage, chosen
from cvqmpt_lab.training.shards import LINKS
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import (
    PointCloudConfig,
    SceneTransformerConfig,
    SceneTransformerSizes,
    SequenceConfig,
)
from cvqmpt_lab.vqmpt.dictionary import Dictionary
from cvqmpt_lab.vqmpt.published_network import PublishedSequenceModel
from cvqmpt_lab.vqmpt.scene_arrays import LONGEST, Ends, group_points
from cvqmpt_lab.vqmpt.scene_transformer import SceneTransformer


class TransformerStage(SequenceStage):
    """Training of a scene transformer."""

    module: SceneTransformer

    def __init__(
        self,
        dataset: SequenceDataset,
        dictionary: Checkpoint,
        settings: RoadmapSettings,
        sizes: SceneTransformerSizes,
        seed: int,
        device: torch.device,
    ) -> None:
        super().__init__(dataset, dictionary, settings, sizes.links, LONGEST, seed, device)
        assert dataset.chain is not None and dataset.roadmap is not None
        graph = dataset.roadmap.graph
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
        """Set priors to the frequency of free codes and edges, or load weights to fine-tune."""
        if not self.settings.fine_tune:
            _begin_with(self.free_shares(), self.module.node_prior, self.module.edge_prior)
            return
        trained = self.dictionary.modules.get("transformer")
        if trained is None or trained.config.sizes != self.config.sizes:
            raise InvalidInputError(
                "fine_tune needs a --dictionary whose weights hold a transformer of the sizes of "
                "transformer_model; leave both out to begin with the shipped weights"
            )
        self.module.load_state_dict(trained.state_dict())

    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Centres (t, 3) and offsets (t, m, 3) [m] of groups of points."""
        sizes = self.config.sizes
        centres, offsets = group_points(points, sizes.groups, sizes.group_size)
        return {"centres": centres, "offsets": offsets}

    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> Predicted:
        """Logits over codes and goal, and log odds that codes, edges and links are free."""
        scenes = self.module.encode(cloud["centres"], cloud["offsets"])
        starts, goals = (self.module.ends(scenes, batch[name]) for name in ("starts", "goals"))
        V = self.module.cost_to_go(scenes, goals)
        start = Ends(*(chosen(part, batch["start"]) for part in starts))
        goal = Ends(*(chosen(part, batch["goal"]) for part in goals))
        logits = self.module.logits(scenes, start, goal, chosen(V, batch["goal"]), batch["codes"])
        links = self.module.link_odds(scenes, batch["link_end"], batch["link_code"])
        return Predicted(logits, scenes.node_odds, scenes.edge_odds, links)

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """The dictionary and the transformer in their present state."""
        config = replace(self.dictionary.config, transformer=self.config)
        modules = {**self.dictionary.modules, "transformer": self.module}
        return Checkpoint(config, self.dictionary.robot, modules, metadata)


@torch.no_grad()
def _begin_with(shares: list[Tensor], node_prior: Tensor, edge_prior: Tensor) -> None:
    """Copy log odds that codes (N,) and edges (E,) are free into a network's priors."""
    node_prior.copy_(shares[0])
    edge_prior.copy_(shares[1])


@dataclass(frozen=True, kw_only=True)
class PublishedSizes:
    """Sizes of the authors' sequence model, by default as published; dense: use the dense loss."""

    point_cloud: PointCloudConfig = field(default_factory=PointCloudConfig)
    sequence: SequenceConfig = field(default_factory=SequenceConfig)
    dense: bool = False


class DenseHead(nn.Module):
    """P(code free) and P(edge free) from scene tokens."""

    edges: Tensor

    def __init__(self, n_nodes: int, edges: np.ndarray, width: int, edge_width: int = 64) -> None:
        super().__init__()
        self.register_buffer("edges", torch.from_numpy(edges.astype(np.int64)), persistent=False)
        self.query = nn.Parameter(0.02 * torch.randn(n_nodes, width))
        self.norm = nn.LayerNorm(width)
        self.key, self.value = nn.Linear(width, width), nn.Linear(width, width)
        self.node, self.node_prior = nn.Linear(width, 1), nn.Parameter(torch.zeros(n_nodes))
        self.part = nn.Linear(width, edge_width)
        self.own_edge = nn.Parameter(0.02 * torch.randn(len(edges), edge_width))
        self.edge, self.edge_prior = nn.Linear(edge_width, 1), nn.Parameter(torch.zeros(len(edges)))

    def forward(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Log odds (s, N) and (s, E) from scene tokens (s, m, width)."""
        seen = self.norm(tokens)
        query = self.query.to(seen.dtype).expand(len(tokens), -1, -1)
        codes = query + F.scaled_dot_product_attention(query, self.key(seen), self.value(seen))
        parts = self.part(codes).float()
        pairs = parts[:, self.edges[:, 0]] + parts[:, self.edges[:, 1]] + self.own_edge
        node = self.node(codes)[..., 0].float() + self.node_prior
        return node, self.edge(pairs.relu())[..., 0].float() + self.edge_prior


class PublishedStage(SequenceStage):
    """Training of a model of the authors' architecture, on labels of a roadmap or on paths."""

    def __init__(
        self,
        dataset: SequenceDataset,
        dictionary: Checkpoint,
        settings: RoadmapSettings,
        sizes: PublishedSizes,
        seed: int,
        device: torch.device,
    ) -> None:
        roadmap = dataset.roadmap
        longest = LONGEST if roadmap is not None else sizes.sequence.max_length - 1
        super().__init__(dataset, dictionary, settings, LINKS, longest, seed, device)
        self.config = replace(
            dictionary.config,
            transformer=None,
            point_cloud=sizes.point_cloud,
            sequence=sizes.sequence,
        )
        self._words: Dictionary = dictionary.modules["dictionary"]
        self._words.to(device).requires_grad_(False)
        self.model, self.dense = PublishedSequenceModel(self.config), None
        if sizes.dense:
            if roadmap is None:
                raise InvalidInputError(
                    f"{dataset.folder} holds paths; the dense loss needs labels on a roadmap "
                    "(cvqmpt data generate --labels roadmap), or set published_model.dense to "
                    "false"
                )
            width = sizes.sequence.transformer.d_model
            self.dense = DenseHead(len(roadmap.graph.nodes), roadmap.graph.edges, width)
        self.module = nn.ModuleList([self.model, *([] if self.dense is None else [self.dense])])
        self.module.to(device)
        limits = torch.tensor([dataset.robot.lower, dataset.robot.upper], device=device)
        self._lower, self._range = limits[0], limits[1] - limits[0]

    def prepare(self) -> None:
        """Set the dense head's priors to the frequency of free codes and edges."""
        if self.dense is not None:
            _begin_with(self.free_shares(), self.dense.node_prior, self.dense.edge_prior)

    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """The cloud's points, unchanged."""
        return {"points": np.asarray(points, dtype=np.float32)}

    def validate(self) -> dict[str, float | None]:
        """Validation metrics, and the share of scene features that are equal for all clouds."""
        constant = self.model.context.env_encoder.constant_features()
        return super().validate() | {"constant_features": constant}

    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> Predicted:
        """Logits (s, r, l + 1, N + 2) over codes, start token and goal; with the dense loss, odds.

        Prefixes of one length are a batch, so that none is padded.
        """
        scene = self.model.encode_scene(cloud["points"])
        ends = [
            (chosen(batch[f"{end}s"], batch[end]) - self._lower) / self._range
            for end in ("start", "goal")
        ]
        context = self.model.encode_context(scene, *(end.flatten(0, 1) for end in ends))
        codes, count = batch["codes"].flatten(0, 1), batch["count"].flatten()
        steps, quantizer = [], self._words.quantizer
        for length in range(codes.shape[1] + 1):
            rows = (count >= length).nonzero()[:, 0]
            prefixes = context[rows], codes[rows, :length]
            logits = self.model.prefix_logits(*prefixes, quantizer).float()
            steps.append(logits.new_zeros(len(codes), logits.shape[-1]).index_copy(0, rows, logits))
        logits = torch.stack(steps, 1).unflatten(0, batch["count"].shape)
        return Predicted(logits, *(() if self.dense is None else self.dense(scene[0])))

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """The dictionary and the sequence model in their present state."""
        modules = {"dictionary": self._words, "sequence_model": self.model}
        return Checkpoint(self.config, self.dictionary.robot, modules, metadata)
