"""Training of sequence models: the next code, from a scene's point cloud, start and goal.

The codes h_1 ... h_l of a path end with the goal class h_(l+1). With the context M of cloud, start
and goal, the loss of a batch is the mean of

    -log p(h_(i+1) | M, h_1 ... h_i),    i = 0 ... l,

over all prefixes of all sequences. On labels of a roadmap the binary cross entropies B of what is
free are added where a model predicts them: B(codes) + 2 B(edges) + 2 B(links). Links are the
motions between configurations and codes near them. Every sequence is learned from both ways.
"""

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.training.clouds import CloudSettings, sample_cloud
from cvqmpt_lab.training.dataset import VALIDATION_EVERY, SequenceDataset
from cvqmpt_lab.training.stage import Batches, OptimizerSettings, Stage, means
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import Size
from cvqmpt_lab.vqmpt.scene_arrays import NOWHERE

Cloud = Mapping[str, Tensor]
"""Clouds of s scenes as a model takes them, every array (s, ...)."""


@dataclass(frozen=True, kw_only=True)
class RoadmapSettings:
    """How a sequence model is trained on sequences of codes."""

    epochs: int = 30
    batches_per_epoch: Size = 400
    scenes: Size = 4  # of a batch
    paths: Size = 96  # of each scene
    goals: Size = 16  # different ones of each scene
    link_ends: Size = 24  # configurations of each scene from which motions to codes are judged
    cloud: CloudSettings = field(
        default_factory=lambda: CloudSettings(points=1024, occlusion=0.3, measured=0.3)
    )
    validation_scenes: Size = 70
    fine_tune: bool = False  # begin with the transformer of the dictionary's weights
    # of most matrix products; losses are always float32
    precision: Literal["float32", "bf16"] = "bf16"
    optimizer: OptimizerSettings = field(
        default_factory=lambda: OptimizerSettings(
            rate=2e-3, warmup=100, schedule="cosine", weight_decay=0.01, clip=1.0
        )
    )


class SequenceStage(Stage):
    """Training of a sequence model.

    Arrays of a batch of s scenes with r code sequences each: those of the clouds (s, ...). starts
    (s, u, n) and goals (s, g, n) [rad]; start and goal (s, r) int64: which of them each sequence
    joins. codes (s, r, l) int64, padded with 0, and count (s, r), how many there are. On a roadmap
    also node_free (s, N) and edge_free (s, E) bool, and of k ends of links link_end (s, k, n)
    [rad], link_code and link_free (s, k, LINKS).
    """

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

        InvalidInputError: the dictionary is of another robot, labels are without kinematics, or
        there are fewer scenes than in a batch.
        """
        super().__init__(settings.optimizer, seed, device)
        self.dataset, self.dictionary, self.settings = dataset, dictionary, settings
        self._links, self._longest = links, longest
        if dataset.graph is not None:
            nodes, codes = len(dataset.graph.nodes), dictionary.config.dictionary.n_codes
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
        validates, scene = dataset.validates, dataset.arrays["path_scene"]
        # sequences of each scene are a range
        self._first = np.searchsorted(scene, np.arange(len(validates) + 1))
        self._count = np.diff(dataset.arrays["code_start"])
        short = np.bincount(scene[self._count <= longest], minlength=len(validates))
        # paths in a scene are fewer than labels on a roadmap
        usable = short >= (1 if dataset.graph is None else 8)
        self._train, self._held_out = (
            np.flatnonzero(usable & which) for which in (~validates, validates)
        )
        if min(len(self._train), len(self._held_out)) < settings.scenes:
            raise InvalidInputError(
                f"{dataset.folder} has {len(self._train)} scenes to train on and "
                f"{len(self._held_out)} to validate with; generate "
                f"{settings.scenes * VALIDATION_EVERY} scenes at least"
            )

    @abstractmethod
    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """A cloud (m, 3) [m] as the model takes it."""

    @abstractmethod
    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """The model's output for a batch of sequences with these clouds.

        code: (s, r, l + 1, classes) logits after every prefix; the last class is the goal. Where it
        predicts what is free: log odds node (s, N), edge (s, E) and link (s, k, LINKS).
        """

    def batches(self, epoch: int) -> Batches:
        """Batches of an epoch: scenes in random order."""
        rng = np.random.default_rng((self.seed, epoch))
        wanted = self.settings.batches_per_epoch * self.settings.scenes
        repeats = -(-wanted // len(self._train))
        scenes = np.concatenate([rng.permutation(self._train) for _ in range(repeats)])[:wanted]
        return self._batches_of(scenes, epoch, augmented=True)

    def _batches_of(self, scenes: np.ndarray, epoch: int, *, augmented: bool) -> Batches:
        make = partial(self._batch, augmented=augmented)
        return Batches(scenes.reshape(-1, self.settings.scenes), make, self.seed, epoch)

    def _batch(
        self, scenes: np.ndarray, rng: np.random.Generator, *, augmented: bool
    ) -> dict[str, np.ndarray]:
        """Arrays of scenes (s,); noise, hidden surfaces and both directions if augmented."""
        counts = self._count[self._first[scenes[0]] : self._first[scenes[0] + 1]]
        drawn = rng.choice(counts) if augmented else None
        each = [self._sequences(scene, drawn, rng, augmented) for scene in scenes]
        settings = self.settings.cloud if augmented else self.settings.cloud.without_augmentation()
        for scene, one in zip(scenes, each, strict=True):
            cloud = sample_cloud(self.dataset.shapes(scene), settings, rng)
            one |= self.cloud_arrays(cloud)
        if self.dataset.graph is not None:
            for scene, one in zip(scenes, each, strict=True):
                one |= self._link_arrays(scene, rng)
        found = {name: _stacked([one[name] for one in each]) for name in each[0]}
        found["codes"] = found["codes"][:, :, : found["count"].max()]
        if self.dataset.graph is not None:
            found["node_free"] = self.dataset.free("node", scenes)
            found["edge_free"] = self.dataset.free("edge", scenes)
        return found

    def _sequences(
        self, scene: int, length: int | None, rng: np.random.Generator, augmented: bool
    ) -> dict[str, np.ndarray]:
        """Sequences of one scene; of about this length, if given, so that few are padded."""
        dataset, settings = self.dataset, self.settings
        rows = np.arange(self._first[scene], self._first[scene + 1])
        rows = rows[self._count[rows] <= self._longest]
        if length is not None:
            # lengths below 4, below 6 and others are about one
            alike = np.digitize(self._count[rows], (4, 6)) == np.digitize(length, (4, 6))
            rows = rows[alike] if alike.sum() >= settings.paths // 6 else rows
        backwards = augmented and rng.random() < 0.5
        ends = dataset.arrays["ends"][:, :: -1 if backwards else 1]
        _, number = np.unique(ends[rows, 1], axis=0, return_inverse=True)
        # each goal costs the scene transformer an evaluation, but nothing without a roadmap
        most = settings.paths if dataset.graph is None else settings.goals
        rows = rows[np.isin(number.reshape(-1), rng.permutation(number.max() + 1)[:most])]
        rows = rng.choice(rows, settings.paths, replace=len(rows) < settings.paths)
        joined = dataset.configurations(ends[rows])
        starts, start = np.unique(joined[:, 0], axis=0, return_inverse=True)
        goals, goal = np.unique(joined[:, 1], axis=0, return_inverse=True)
        count, place = self._count[rows], np.arange(self._longest)
        inside = place < count[:, None]
        at = np.where(inside, count[:, None] - 1 - place if backwards else place, 0)
        codes = dataset.arrays["codes"][dataset.arrays["code_start"][rows][:, None] + at]
        return {
            "starts": starts,
            "goals": goals,
            "start": start.reshape(-1),
            "goal": goal.reshape(-1),
            "codes": np.where(inside, codes, 0).astype(np.int64),
            "count": count,
        }

    def _link_arrays(self, scene: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Some of a scene's links on a roadmap."""
        arrays, wanted = self.dataset.arrays, self.settings.link_ends
        first, last = arrays["link_start"][scene : scene + 2]
        rows = rng.choice(np.arange(first, last), wanted, replace=last - first < wanted)
        return {
            "link_end": self.dataset.configurations(arrays["link_end"][rows]),
            "link_code": arrays["link_code"][rows].astype(np.int64),
            "link_free": arrays["link_free"][rows],
        }

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """-log p(h_(i+1) | M, h_1 ... h_i), B(codes) + 2 B(edges) + 2 B(links); see the module."""
        bf16 = self.settings.precision == "bf16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=bf16):
            predicted = self.predict(batch, batch)
        logits = predicted["code"].flatten(0, 2).float()
        targets = self.targets(batch, logits.shape[-1] - 1).flatten()
        code = F.cross_entropy(logits, targets)
        found = {"loss": code, "code": code}
        for name, weight in (("node", 1.0), ("edge", 2.0), ("link", 2.0)):
            if name in predicted:
                free = batch[f"{name}_free"].float()
                found[name] = F.binary_cross_entropy_with_logits(predicted[name], free)
                found["loss"] = found["loss"] + weight * found[name]
        return found

    @staticmethod
    def targets(batch: dict[str, Tensor], goal: int) -> Tensor:
        """Next codes h_(i+1) (s, r, l + 1) int64; -100, not counted, after `goal`."""
        codes, count = batch["codes"], batch["count"][..., None]
        step = torch.arange(codes.shape[2] + 1, device=codes.device)
        following = F.pad(codes, (0, 1)).masked_fill(step == count, goal)
        return following.masked_fill(step > count, -100)

    def validate(self) -> dict[str, float | None]:
        """Means on held-out scenes: with their own cloud, that of the next scene, and none."""
        rows, size = self._held_out[: self.settings.validation_scenes], self.settings.scenes
        batches = self._batches_of(rows[: len(rows) // size * size], 0, augmented=False)
        return means(chain.from_iterable(map(self._measured, batches)))

    def _measured(self, arrays: dict[str, np.ndarray]) -> Iterator[tuple[str, float, float]]:
        """Cross entropies of a batch: name, sum and count of each."""
        batch = self.tensors(arrays)
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
            logits = predicted["code"]
            targets = self.targets(batch, logits.shape[-1] - 1).flatten()
            choices = {"all": logits}
            if ways is not None:
                # a start token, which nothing leads to, may stand before the goal
                extra = ways.new_zeros(*ways.shape[:-1], logits.shape[-1] - ways.shape[-1])
                allowed = torch.cat((ways[..., :-1], extra, ways[..., -1:]), -1)
                choices["ways"] = logits.masked_fill(~allowed, -torch.inf)
            for which, odds in choices.items():
                each = F.cross_entropy(odds.flatten(0, 2), targets, reduction="none")
                counted = each[(targets >= 0) & each.isfinite()]
                yield f"{prefix}cross_entropy_{which}", float(counted.sum()), len(counted)
            if prefix == "":
                yield "loss", float(counted.sum()), len(counted)

    def _ways(self, batch: dict[str, Tensor]) -> Tensor | None:
        """Successors on a roadmap: codes and goal (s, r, l + 1, N + 1) by an edge or link."""
        if self.dataset.graph is None:
            return None
        nodes = torch.from_numpy(self.dataset.graph.nodes).float().to(self.device)
        edges = torch.from_numpy(self.dataset.graph.edges.astype(np.int64)).to(self.device)
        start, goal = chosen(batch["starts"], batch["start"]), chosen(batch["goals"], batch["goal"])
        return roadmap_successors(nodes, edges, self._links, start, goal, batch["codes"])


def chosen(values: Tensor, rows: Tensor) -> Tensor:
    """Values (s, r, ...) at rows (s, r) of each scene's values (s, u, ...)."""
    return values[torch.arange(len(values), device=values.device)[:, None], rows]


def _stacked(arrays: list[np.ndarray]) -> np.ndarray:
    """Stack arrays of different lengths; shorter ones repeat their rows."""
    rows = max(map(len, arrays))
    return np.stack([array[np.arange(rows) % len(array)] for array in arrays])


def roadmap_successors(
    nodes: Tensor, edges: Tensor, links: int, start: Tensor, goal: Tensor, codes: Tensor
) -> Tensor:
    """Classes that can follow each prefix of codes on a roadmap.

    Args:
        nodes: (N, n) [rad].
        edges: (E, 2).
        links: number of nodes that a start or goal is linked to.
        start: (s, r, n) [rad].
        goal: (s, r, n) [rad].
        codes: (s, r, l).

    Returns:
        (s, r, l + 1, N + 1) bool.
    """
    classes = len(nodes) + 1
    near = [
        torch.cdist(q.flatten(0, 1), nodes).topk(links, largest=False)[1] for q in (start, goal)
    ]
    first, last = (
        torch.zeros(len(rows), classes, device=codes.device).scatter(1, rows, 1.0) for rows in near
    )
    table = torch.zeros(len(nodes), classes, device=codes.device)
    table[edges[:, 0], edges[:, 1]] = table[edges[:, 1], edges[:, 0]] = 1.0
    following = table[codes.flatten(0, 1)]  # (s r, l, N + 1)
    following[..., -1] = last.gather(1, codes.flatten(0, 1))
    return torch.cat((first[:, None], following), 1).bool().view(*codes.shape[:2], -1, classes)
