"""The two sequence models that `sequence_stage` trains: scene transformer, authors' architecture.

Both get the same scenes, clouds, sequences and validation.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.training.dataset import (
    SequenceDataset,
    holds_labels,
    open_dataset,
    open_labels,
)
from cvqmpt_lab.training.sequence_stage import Cloud, RoadmapSettings, SequenceStage, chosen
from cvqmpt_lab.training.shards import LINKS, SCENE_ARRAYS
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import (
    PointCloudConfig,
    SceneTransformerConfig,
    SceneTransformerSizes,
    SequenceConfig,
)
from cvqmpt_lab.vqmpt.dictionary import LinkPositions
from cvqmpt_lab.vqmpt.published_network import PublishedSequenceModel
from cvqmpt_lab.vqmpt.scene_arrays import LONGEST, Ends, group_points
from cvqmpt_lab.vqmpt.scene_transformer import SceneTransformer


def open_sequences(folder: Path, dictionary: Checkpoint) -> SequenceDataset:
    """Read labels on a roadmap, or encode paths: a code a waypoint, repeats left out.

    InvalidInputError: as of `open_labels` and `open_dataset`, or paths of another robot.
    """
    if holds_labels(folder):
        return open_labels(folder)
    paths = open_dataset(folder)
    dictionary.robot.require_same(paths.robot)
    start = paths.arrays["path_start"]
    every = np.arange(len(start) - 1)
    rows = paths.with_few_trivial(every, 0.15, np.random.default_rng(0))
    chain = paths.chain if dictionary.config.feature_dim else None
    links = LinkPositions(paths.robot.lower, paths.robot.upper, chain)
    counts = np.diff(start)[rows]
    each: list[np.ndarray] = [np.empty(0)] * len(rows)
    words = dictionary.modules["dictionary"]
    # the encoder sees padding, and paths of one length need none
    for count in np.unique(counts).tolist():
        alike = np.flatnonzero(counts == count)
        for some in np.array_split(alike, -(-len(alike) // 64)):
            with torch.no_grad():
                u = torch.from_numpy(paths.padded(rows[some])[0])
                codes = words.encode(links.configurations(u)).numpy()
            for row, own in zip(some.tolist(), codes, strict=True):
                each[row] = own[np.append(True, own[1:] != own[:-1])]
    ends = np.stack([start[rows], start[rows + 1] - 1], axis=1)
    sequences = {
        "path_scene": paths.arrays["path_scene"][rows],
        "ends": paths.arrays["waypoints"][ends],
        "code_start": np.cumsum([0, *map(len, each)]),
        "codes": np.concatenate(each),
    }
    scenes = {name: paths.arrays[name] for name in SCENE_ARRAYS}
    return SequenceDataset(**vars(paths) | {"arrays": scenes | sequences}, graph=None)


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
        super().__init__(dataset, dictionary, settings, sizes.links, LONGEST, seed, device)
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
        """Set priors to the frequency of free codes and edges, or load weights to fine-tune."""
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
                "transformer_model; leave both out to begin with the shipped weights"
            )
        self.model.load_state_dict(trained.state_dict())

    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Centres (t, 3) and offsets (t, m, 3) [m] of groups of points."""
        sizes = self.config.sizes
        centres, offsets = group_points(points, sizes.groups, sizes.group_size)
        return {"centres": centres, "offsets": offsets}

    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Logits over codes and goal, and log odds that codes, edges and links are free."""
        scenes = self.model.encode(cloud["centres"], cloud["offsets"])
        starts, goals = (self.model.ends(scenes, batch[name]) for name in ("starts", "goals"))
        V = self.model.cost_to_go(scenes, goals)
        start = Ends(*(chosen(part, batch["start"]) for part in starts))
        goal = Ends(*(chosen(part, batch["goal"]) for part in goals))
        logits = self.model.logits(scenes, start, goal, chosen(V, batch["goal"]), batch["codes"])
        links = self.model.link_odds(scenes, batch["link_end"], batch["link_code"])
        return {"code": logits, "node": scenes.node_odds, "edge": scenes.edge_odds, "link": links}

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """The dictionary and the transformer in their present state."""
        config = replace(self.dictionary.config, transformer=self.config)
        modules = {**self.dictionary.modules, "transformer": self.model}
        return Checkpoint(config, self.dictionary.robot, modules, metadata)


@dataclass(frozen=True, kw_only=True)
class PublishedSizes:
    """Sizes of the authors' sequence model, by default as published."""

    point_cloud: PointCloudConfig = field(default_factory=PointCloudConfig)
    sequence: SequenceConfig = field(default_factory=SequenceConfig)


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
        graph = dataset.graph
        longest = LONGEST if graph is not None else sizes.sequence.max_length - 1
        super().__init__(dataset, dictionary, settings, LINKS, longest, seed, device)
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
        """The cloud's points, unchanged."""
        return {"points": np.asarray(points, dtype=np.float32)}

    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Logits (s, r, l + 1, N + 2) over codes, start token and goal.

        Prefixes of one length are a batch, so that none is padded.
        """
        scene = self.model.encode_scene(cloud["points"])
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
        """The dictionary and the sequence model in their present state."""
        words = self.dictionary.modules["dictionary"]
        modules = {"dictionary": words, "sequence_model": self.model}
        return Checkpoint(self.config, self.dictionary.robot, modules, metadata)
