"""Training of sequence models: the next code, from a scene's point cloud, start and goal.

The codes h_1 ... h_l of a path end with the goal class h_(l+1). With the context M of cloud, start
and goal, the loss of a batch is the mean of

    -log p(h_(i+1) | M, h_1 ... h_i),    i = 0 ... l,

over all prefixes of all sequences. On labels of a roadmap the binary cross entropies B of what is
free are added where a model predicts them: B(codes) + 2 B(edges) + 2 B(links). Links are the
motions between configurations and codes near them. Every sequence is learned from both ways.
"""

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.training.batches import RoadmapSettings, SequenceBatches
from cvqmpt_lab.training.dataset import (
    VALIDATION_EVERY,
    SequenceDataset,
    holds_labels,
    open_dataset,
    open_labels,
    with_few_trivial,
)
from cvqmpt_lab.training.stage import Means, Stage
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.link_positions import LinkPositions
from cvqmpt_lab.vqmpt.scene_arrays import NOWHERE
from cvqmpt_lab.vqmpt.scene_transformer import roadmap_successors

NO_TARGET = -100

Cloud = Mapping[str, Tensor]
"""Clouds of s scenes as a model takes them, every array (s, ...)."""


class Predicted(NamedTuple):
    """A model's output for a batch."""

    logits: Tensor  # (s, r, l + 1, classes) after every prefix; the last class is the goal
    node_odds: Tensor | None = None  # (s, N), log odds of P(code free)
    edge_odds: Tensor | None = None  # (s, E), log odds of P(edge free)
    link_odds: Tensor | None = None  # (s, k, LINKS), log odds of P(link free)


def open_sequences(folder: Path, dictionary: Checkpoint) -> SequenceDataset:
    """Read labels on a roadmap, or encode paths: a code a waypoint, repeats left out.

    InvalidInputError: as of `open_labels` and `open_dataset`, or paths of another robot.
    """
    if holds_labels(folder):
        return open_labels(folder)
    dataset = open_dataset(folder)
    dictionary.robot.require_same(dataset.robot)
    paths, robot = dataset.paths, dataset.robot
    once = np.flatnonzero(paths.twin_of < 0)
    rows = with_few_trivial(paths, once, 0.15, np.random.default_rng(0))
    chain = dataset.chain if dictionary.config.feature_dim else None
    links, counts = LinkPositions(robot.lower, robot.upper, chain), paths.counts(rows)
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
    first, last = paths.start[rows], paths.start[rows + 1] - 1
    return SequenceDataset(
        folder=dataset.folder,
        robot=robot,
        families=dataset.families,
        chain=dataset.chain,
        sha256=dataset.sha256,
        scenes=dataset.scenes,
        path_scene=paths.scene[rows],
        ends=np.stack([paths.waypoints[first], paths.waypoints[last]], axis=1),
        code_start=np.cumsum([0, *map(len, each)]),
        codes=np.concatenate(each),
        roadmap=None,
    )


class SequenceStage(Stage):
    """Training of a sequence model."""

    selection = "validation_loss"
    dataset: SequenceDataset

    def __init__(
        self,
        dataset: SequenceDataset,
        dictionary: Checkpoint,
        settings: RoadmapSettings,
        links: int,
        longest: int,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on sequences of a dictionary's codes.

        Args:
            dataset: of sequences.
            dictionary: of stage 1, whose codes they are of.
            settings: how to train.
            links: codes that a start or goal leads to.
            longest: codes of a sequence at most; longer ones are left out.
            seed: of all that is drawn.
            device: to train on.

        InvalidInputError: the dictionary is of another robot, or labels are without kinematics.
        """
        super().__init__(settings.optimizer, seed, device)
        self.dataset, self.dictionary, self.settings = dataset, dictionary, settings
        self._links, self._longest = links, longest
        if dataset.roadmap is not None:
            nodes, codes = len(dataset.roadmap.graph.nodes), dictionary.config.dictionary.n_codes
            if dictionary.robot.differences(dataset.robot) or nodes != codes:
                raise InvalidInputError(
                    f"{dataset.folder} labels the roadmap of a dictionary of robot "
                    f"{dataset.robot.name!r} with {nodes} codes, but this one is of "
                    f"{dictionary.robot.name!r} with {codes}; give --dictionary DIR, the same as "
                    "to cvqmpt data generate"
                )
            if dataset.chain is None:
                raise InvalidInputError(
                    f"{dataset.folder} has no kinematics; generate its labels again"
                )
        short = dataset.path_scene[np.diff(dataset.code_start) <= longest]
        count = np.bincount(short, minlength=len(dataset.scenes))
        # paths in a scene are fewer than labels on a roadmap
        usable = count >= (1 if dataset.roadmap is None else 8)
        validates = dataset.scenes.validate
        self._train = np.flatnonzero(usable & ~validates)
        self._held_out = np.flatnonzero(usable & validates)

    def require_splits(self) -> None:
        """Raise InvalidInputError for fewer scenes than in a batch."""
        scenes = self.settings.scenes
        if len(self._train) < scenes or len(self._held_out) < scenes:
            raise InvalidInputError(
                f"{self.dataset.folder} has {len(self._train)} scenes to train on and "
                f"{len(self._held_out)} to validate with; generate {scenes * VALIDATION_EVERY} "
                "scenes at least"
            )

    @abstractmethod
    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """A cloud (m, 3) [m] as the model takes it."""

    @abstractmethod
    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> Predicted:
        """The model's output for a batch of sequences with these clouds."""

    def free_shares(self) -> list[Tensor]:
        """Log odds log(p / (1 - p)); p: share of training scenes where a code, an edge is free."""
        assert self.dataset.roadmap is not None
        rows = self._train[:: max(1, len(self._train) // 2000)]
        shares = (torch.from_numpy(each.mean(axis=0)) for each in self.dataset.roadmap.free(rows))
        return [torch.logit(share.float().clamp(0.01, 0.99)) for share in shares]

    def batches(self, epoch: int) -> SequenceBatches:
        """Batches of an epoch: scenes in random order."""
        rng = np.random.default_rng((self.seed, epoch))
        wanted = self.settings.batches_per_epoch * self.settings.scenes
        repeats = -(-wanted // len(self._train))
        scenes = np.concatenate([rng.permutation(self._train) for _ in range(repeats)])[:wanted]
        return self._batches_of(scenes, (self.seed, epoch))

    def _batches_of(
        self, scenes: np.ndarray, seed: tuple[int, int], augmented: bool = True
    ) -> SequenceBatches:
        rows = scenes.reshape(-1, self.settings.scenes)
        given = self.dataset, self.settings, self.cloud_arrays
        return SequenceBatches(*given, rows, self._longest, seed, augmented)

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """-log p(h_(i+1) | M, h_1 ... h_i), B(codes) + 2 B(edges) + 2 B(links); see the module."""
        bf16 = self.settings.precision == "bf16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=bf16):
            predicted = self.predict(batch, batch)
        logits = predicted.logits
        targets = self.targets(batch, logits.shape[-1] - 1)
        code = F.cross_entropy(
            logits.flatten(0, 2).float(), targets.flatten(), ignore_index=NO_TARGET
        )
        found = {"loss": code, "code": code}
        for name, weight in (("node", 1.0), ("edge", 2.0), ("link", 2.0)):
            odds = getattr(predicted, f"{name}_odds")
            if odds is not None:
                free = batch[f"{name}_free"].float()
                found[name] = F.binary_cross_entropy_with_logits(odds, free)
                found["loss"] = found["loss"] + weight * found[name]
        return found

    @staticmethod
    def targets(batch: dict[str, Tensor], goal: int) -> Tensor:
        """Next codes h_(i+1) (s, r, l + 1) int64; after the last `goal`, then NO_TARGET."""
        codes, count = batch["codes"], batch["count"][..., None]
        step = torch.arange(codes.shape[2] + 1, device=codes.device)
        following = F.pad(codes, (0, 1)).masked_fill(step == count, goal)
        return following.masked_fill(step > count, NO_TARGET)

    def validate(self) -> dict[str, float | None]:
        """Means on held-out scenes: with their own cloud, that of the next scene, and none."""
        rows = self._held_out[: self.settings.validation_scenes]
        rows = rows[: len(rows) // self.settings.scenes * self.settings.scenes]
        batches, means = self._batches_of(rows, (self.seed, 0), augmented=False), Means()
        for number in range(len(batches)):
            self._measure(means, self.tensors(batches[number]))
        return means.values()

    def _measure(self, means: Means, batch: dict[str, Tensor]) -> None:
        """Accumulate the metrics of a batch: cross entropies, and areas under curves."""
        nowhere = np.tile(np.array(NOWHERE, dtype=np.float32), (self.settings.cloud.points, 1))
        empty = self.tensors(self.cloud_arrays(nowhere))
        clouds: dict[str, Cloud] = {
            "": batch,
            "wrong_cloud_": {name: batch[name].roll(1, 0) for name in empty},
            "no_cloud_": {name: one.expand_as(batch[name]) for name, one in empty.items()},
        }
        ways = self._ways(batch)
        for prefix, given in clouds.items():
            predicted = self.predict(given, batch)
            logits = predicted.logits
            targets = self.targets(batch, logits.shape[-1] - 1).flatten()
            choices = {"all": logits}
            if ways is not None:
                # a start token, which nothing leads to, may stand before the goal
                extra = ways.new_zeros(*ways.shape[:-1], logits.shape[-1] - ways.shape[-1])
                allowed = torch.cat((ways[..., :-1], extra, ways[..., -1:]), -1)
                choices["ways"] = logits.masked_fill(~allowed, -torch.inf)
            for which, odds in choices.items():
                each = F.cross_entropy(
                    odds.flatten(0, 2), targets, ignore_index=NO_TARGET, reduction="none"
                )
                counted = each[(targets != NO_TARGET) & each.isfinite()]
                means.add(f"{prefix}cross_entropy_{which}", float(counted.sum()), len(counted))
            if prefix == "":
                means.add("loss", float(counted.sum()), len(counted))
                for name in ("node", "edge", "link"):
                    odds = getattr(predicted, f"{name}_odds")
                    if odds is not None:
                        free = batch[f"{name}_free"].flatten(1)
                        areas = map(area_under_curve, odds.flatten(1), free)
                        known = [area for area in areas if area is not None]
                        means.add(f"{name}_area_under_curve", sum(known), len(known))

    def _ways(self, batch: dict[str, Tensor]) -> Tensor | None:
        """Successors on a roadmap: codes and goal (s, r, l + 1, N + 1) by an edge or link."""
        if self.dataset.roadmap is None:
            return None
        graph = self.dataset.roadmap.graph
        nodes = torch.from_numpy(graph.nodes).float().to(self.device)
        edges = torch.from_numpy(graph.edges.astype(np.int64)).to(self.device)
        start, goal = chosen(batch["starts"], batch["start"]), chosen(batch["goals"], batch["goal"])
        return roadmap_successors(nodes, edges, self._links, start, goal, batch["codes"])


def chosen(values: Tensor, rows: Tensor) -> Tensor:
    """Values (s, r, ...) at rows (s, r) of each scene's values (s, u, ...)."""
    return values[torch.arange(len(values), device=values.device)[:, None], rows]


def area_under_curve(odds: Tensor, free: Tensor) -> float | None:
    """Area under the ROC curve of odds (k,) against free (k,); None where all are alike.

    With ranks R of the g free ones among k = g + b: (sum R - g (g + 1) / 2) / (g b).
    """
    good, bad = odds[free], odds[~free]
    if not len(good) or not len(bad):
        return None
    rank = torch.cat((good, bad)).argsort().argsort().double() + 1.0
    below = rank[: len(good)].sum() - len(good) * (len(good) + 1) / 2
    return float(below / (len(good) * len(bad)))
