"""Training of sequence models: the next code, from a scene's point cloud, start and goal.

The codes h_1 ... h_l of a path end with the goal class h_(l+1). With the context M of cloud, start
and goal, the loss of a batch is the mean of

    -log p(h_(i+1) | M, h_1 ... h_i),    i = 0 ... l,

over all prefixes of all sequences. If a model also predicts which nodes, edges and links of a
roadmap are free of collision, their binary cross entropies are added: B(nodes) + 2 B(edges) +
2 B(links). Links are the straight motions between configurations and the nodes near them. Every
sequence is used in both directions.
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
from cvqmpt_lab.training.dataset import VALIDATION_EVERY
from cvqmpt_lab.training.sequence_dataset import SequenceDataset
from cvqmpt_lab.training.stage import Batches, OptimizerSettings, Stage, means
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.code_nodes import code_noise, drawn_nodes
from cvqmpt_lab.vqmpt.config import SceneTransformerConfig, Size

Cloud = Mapping[str, Tensor]
"""Clouds of s scenes in the form that a model takes; every tensor is (s, ...)."""


@dataclass(frozen=True, kw_only=True)
class RoadmapSettings:
    """How a sequence model is trained on sequences of codes."""

    epochs: Size = 30
    batches_per_epoch: Size = 400
    scenes: Size = 4  # scenes of a batch
    paths: Size = 96  # sequences of each scene
    goals: Size = 16  # different goals of each scene
    link_ends: Size = 24  # configurations of each scene whose links are predicted
    cloud: CloudSettings = field(
        default_factory=lambda: CloudSettings(points=1024, occlusion=0.3, measured=0.3)
    )
    validation_scenes: Size = 70
    fine_tune: bool = False  # start from the transformer of the dictionary's weights
    # precision of most matrix products; losses are always float32
    precision: Literal["float32", "bf16"] = "bf16"
    optimizer: OptimizerSettings = field(
        default_factory=lambda: OptimizerSettings(
            rate=2e-3, warmup=100, schedule="cosine", weight_decay=0.01, clip=1.0
        )
    )


class SequenceStage(Stage):
    """Training of a sequence model.

    A batch has s scenes with r code sequences each, u starts and g goals. Its arrays are

    - arrays of the clouds (s, ...), see `cloud_arrays`;
    - starts (s, u, n) and goals (s, g, n) [rad];
    - start and goal (s, r) int64: row in starts and goals for each sequence;
    - codes (s, r, l) int64, padded with 0, and count (s, r), the length of each sequence;
    - on a roadmap also node_free (s, N) and edge_free (s, E) bool, and links of k configurations:
      link_end (s, k, n) [rad], link_code and link_free (s, k, LINKS_PER_END).
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
            dataset: sequences of the dictionary's codes.
            dictionary: result of stage 1.
            settings: how to train.
            links: number of nearest nodes that a start or goal is linked to.
            longest: maximum number of codes of a sequence; longer sequences are left out.
            seed: seed of all random numbers.
            device: device to train on.

        Raises:
            InvalidInputError: labels or paths are of another dictionary, labels have no
                kinematics, or there are fewer scenes than in a batch.
        """
        super().__init__(settings.optimizer, seed, device)
        self.dataset, self.dictionary, self.settings = dataset, dictionary, settings
        self._links, self._longest = links, longest
        if dataset.graph is not None:
            nodes, codes = len(dataset.graph.nodes), dictionary.config.dictionary.n_codes
            same = "give --dictionary DIR, the same as to cvqmpt data generate"
            if dictionary.robot.differences(dataset.robot) or nodes != codes:
                raise InvalidInputError(
                    f"{dataset.folder} labels the roadmap of a dictionary of robot "
                    f"{dataset.robot.name!r} with {nodes} codes, but this one is of "
                    f"{dictionary.robot.name!r} with {codes}; {same}"
                )
            apart = np.abs(nodes_of(dictionary) - dataset.graph.nodes).max()
            if apart > 1e-3:
                raise InvalidInputError(
                    f"{dataset.folder} labels the roadmap of another dictionary: its nodes "
                    f"differ by up to {apart:.2g} rad or m; {same}"
                )
            if dataset.chain is None:
                raise InvalidInputError(
                    f"{dataset.folder} has no kinematics; generate its labels again"
                )
        validates, scene = dataset.validates, dataset.arrays["path_scene"]
        # scene i has the sequences first[i] ... first[i + 1] - 1
        self._first = np.searchsorted(scene, np.arange(len(validates) + 1))
        self._count = np.diff(dataset.arrays["code_start"])
        short = np.bincount(scene[self._count <= longest], minlength=len(validates))
        # datasets of paths have fewer sequences in a scene than labels on a roadmap
        usable = short >= (1 if dataset.graph is None else 8)
        self._train = np.flatnonzero(usable & ~validates)
        self._held_out = np.flatnonzero(usable & validates)
        if min(len(self._train), len(self._held_out)) < settings.scenes:
            raise InvalidInputError(
                f"{dataset.folder} has {len(self._train)} scenes to train on and "
                f"{len(self._held_out)} to validate with; generate at least "
                f"{settings.scenes * VALIDATION_EVERY} scenes"
            )

    @abstractmethod
    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """Convert a cloud (m, 3) [m] to the arrays that the model takes."""

    @abstractmethod
    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Evaluate the model for a batch of sequences with these clouds.

        Returns:
            code: logits (s, r, l + 1, classes) after every prefix; the last class is the goal. If
            the model predicts what is free, also log odds node (s, N), edge (s, E) and link
            (s, k, LINKS_PER_END).
        """

    def batches(self, epoch: int) -> Batches:
        """Return the batches of an epoch: scenes in random order."""
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
        """Return the arrays of a batch.

        Args:
            scenes: (s,), rows of the scenes.
            rng: random numbers.
            augmented: use noise, hidden surfaces and both directions of sequences.
        """
        counts = self._count[self._first[scenes[0]] : self._first[scenes[0] + 1]]
        length = rng.choice(counts) if augmented else None
        by_scene = [self._sequences(scene, length, rng, augmented) for scene in scenes]
        settings = self.settings.cloud if augmented else self.settings.cloud.without_augmentation()
        for scene, arrays in zip(scenes, by_scene, strict=True):
            cloud = sample_cloud(self.dataset.shapes(scene), settings, rng)
            arrays |= self.cloud_arrays(cloud)
        if self.dataset.graph is not None:
            for scene, arrays in zip(scenes, by_scene, strict=True):
                arrays |= self._link_arrays(scene, rng)
        batch = {name: _stacked([arrays[name] for arrays in by_scene]) for name in by_scene[0]}
        batch["codes"] = batch["codes"][:, :, : batch["count"].max()]
        if self.dataset.graph is not None:
            batch["node_free"] = self.dataset.free("node", scenes)
            batch["edge_free"] = self.dataset.free("edge", scenes)
        return batch

    def _sequences(
        self, scene: int, length: int | None, rng: np.random.Generator, augmented: bool
    ) -> dict[str, np.ndarray]:
        """Draw sequences of a scene; of a similar length if one is given, to have little padding.

        Lengths count as similar if both are < 4, both 4 or 5, or both >= 6.
        """
        dataset, settings = self.dataset, self.settings
        rows = np.arange(self._first[scene], self._first[scene + 1])
        rows = rows[self._count[rows] <= self._longest]
        if length is not None:
            similar = np.digitize(self._count[rows], (4, 6)) == np.digitize(length, (4, 6))
            if similar.sum() >= settings.paths // 6:
                rows = rows[similar]
        backwards = augmented and rng.random() < 0.5
        ends = dataset.arrays["ends"][:, :: -1 if backwards else 1]
        # few different goals, since the scene transformer computes costs to go for each of them;
        # a model without a roadmap does not
        _, number = np.unique(ends[rows, 1], axis=0, return_inverse=True)
        most = settings.paths if dataset.graph is None else settings.goals
        rows = rows[np.isin(number.reshape(-1), rng.permutation(number.max() + 1)[:most])]
        rows = rng.choice(rows, settings.paths, replace=len(rows) < settings.paths)
        q = dataset.configurations(ends[rows])
        starts, start = np.unique(q[:, 0], axis=0, return_inverse=True)
        goals, goal = np.unique(q[:, 1], axis=0, return_inverse=True)
        count = self._count[rows]
        place = np.arange(self._longest)
        inside = place < count[:, None]
        offset = np.where(inside, count[:, None] - 1 - place if backwards else place, 0)
        codes = dataset.arrays["codes"][dataset.arrays["code_start"][rows][:, None] + offset]
        return {
            "starts": starts,
            "goals": goals,
            "start": start.reshape(-1),
            "goal": goal.reshape(-1),
            "codes": np.where(inside, codes, 0).astype(np.int64),
            "count": count,
        }

    def _link_arrays(self, scene: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Draw some configurations of a scene, with their links to nodes of the roadmap."""
        arrays, wanted = self.dataset.arrays, self.settings.link_ends
        first, last = arrays["link_start"][scene : scene + 2]
        rows = rng.choice(np.arange(first, last), wanted, replace=last - first < wanted)
        return {
            "link_end": self.dataset.configurations(arrays["link_end"][rows]),
            "link_code": arrays["link_code"][rows].astype(np.int64),
            "link_free": arrays["link_free"][rows],
        }

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Compute the loss of the module's docstring and its parts, scalars."""
        bf16 = self.settings.precision == "bf16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=bf16):
            predicted = self.predict(batch, batch)
        logits = predicted["code"].flatten(0, 2).float()
        targets = self.targets(batch, logits.shape[-1] - 1).flatten()
        code = F.cross_entropy(logits, targets)
        losses = {"loss": code, "code": code}
        for name, weight in (("node", 1.0), ("edge", 2.0), ("link", 2.0)):
            if name in predicted:
                free = batch[f"{name}_free"].float()
                losses[name] = F.binary_cross_entropy_with_logits(predicted[name], free)
                losses["loss"] = losses["loss"] + weight * losses[name]
        return losses

    @staticmethod
    def targets(batch: dict[str, Tensor], goal: int) -> Tensor:
        """Return the next class h_(i+1) (s, r, l + 1) int64 of each prefix.

        The class `goal` follows the last code. After it the target is -100, which torch's cross
        entropy ignores.
        """
        codes, count = batch["codes"], batch["count"][..., None]
        step = torch.arange(codes.shape[2] + 1, device=codes.device)
        following = F.pad(codes, (0, 1)).masked_fill(step == count, goal)
        return following.masked_fill(step > count, -100)

    def validate(self) -> dict[str, float | None]:
        """Mean losses on held-out scenes, with their own cloud, another scene's cloud and none."""
        rows, size = self._held_out[: self.settings.validation_scenes], self.settings.scenes
        batches = self._batches_of(rows[: len(rows) // size * size], 0, augmented=False)
        return means(chain.from_iterable(map(self._measured, batches)))

    def _measured(self, arrays: dict[str, np.ndarray]) -> Iterator[tuple[str, float, float]]:
        """Yield name, sum and number of terms of each cross entropy of a batch.

        ``cross_entropy_all`` is over all classes, ``cross_entropy_ways`` over those that an edge or
        link of the roadmap leads to. The selecting ``loss`` is the latter if there is a roadmap.
        """
        batch = self.tensors(arrays)
        point = np.array(SceneTransformerConfig.empty_cloud_point, dtype=np.float32)
        empty = self.tensors(self.cloud_arrays(np.tile(point, (self.settings.cloud.points, 1))))
        clouds: dict[str, Cloud] = {
            "": batch,
            "wrong_cloud_": {name: batch[name].roll(1, 0) for name in empty},
            "no_cloud_": {name: one.expand_as(batch[name]) for name, one in empty.items()},
        }
        successors = self._successors(batch)
        for prefix, cloud in clouds.items():
            logits = self.predict(cloud, batch)["code"]
            targets = self.targets(batch, logits.shape[-1] - 1).flatten()
            choices = {"all": logits}
            if successors is not None:
                # the authors' network has one more class before the goal, the start token, which
                # is never a successor
                missing = logits.shape[-1] - successors.shape[-1]
                never = successors.new_zeros(*successors.shape[:-1], missing)
                allowed = torch.cat((successors[..., :-1], never, successors[..., -1:]), -1)
                choices["ways"] = logits.masked_fill(~allowed, -torch.inf)
            for name, allowed_logits in choices.items():
                terms = F.cross_entropy(allowed_logits.flatten(0, 2), targets, reduction="none")
                counted = terms[(targets >= 0) & terms.isfinite()]
                yield f"{prefix}cross_entropy_{name}", float(counted.sum()), len(counted)
            if prefix == "":
                yield "loss", float(counted.sum()), len(counted)

    def _successors(self, batch: dict[str, Tensor]) -> Tensor | None:
        """Classes (s, r, l + 1, N + 1) that can follow each prefix; None without a roadmap."""
        if self.dataset.graph is None:
            return None
        nodes = torch.from_numpy(self.dataset.graph.nodes).float().to(self.device)
        edges = torch.from_numpy(self.dataset.graph.edges.astype(np.int64)).to(self.device)
        start, goal = chosen(batch["starts"], batch["start"]), chosen(batch["goals"], batch["goal"])
        return roadmap_successors(nodes, edges, self._links, start, goal, batch["codes"])


def nodes_of(dictionary: Checkpoint) -> np.ndarray:
    """Return the nodes (codes, n) [rad or m] of a dictionary's roadmap.

    `codebook.dictionary_nodes` does the same in numpy, with compiled functions.
    """
    module, robot = dictionary.modules["dictionary"], dictionary.robot
    with torch.no_grad():
        gaussians = module.decode(module.quantizer.embedding.weight)
    means, covariances = (
        part.double().cpu().numpy() for part in (gaussians.mean, gaussians.covariance)
    )
    lower, span = np.array(robot.lower), np.subtract(robot.upper, robot.lower)
    noise = code_noise(*means.shape)
    return drawn_nodes(lower + means * span, covariances * np.outer(span, span), robot, noise)


def chosen(values: Tensor, rows: Tensor) -> Tensor:
    """Return rows (s, r) of each scene's values (s, u, ...), as (s, r, ...)."""
    return values[torch.arange(len(values), device=values.device)[:, None], rows]


def _stacked(arrays: list[np.ndarray]) -> np.ndarray:
    """Stack arrays of different lengths; shorter arrays repeat their rows."""
    rows = max(map(len, arrays))
    return np.stack([array[np.arange(rows) % len(array)] for array in arrays])


def roadmap_successors(
    nodes: Tensor, edges: Tensor, links: int, start: Tensor, goal: Tensor, codes: Tensor
) -> Tensor:
    """Find the classes that can follow each prefix of codes on a roadmap.

    Args:
        nodes: (N, n) [rad].
        edges: (E, 2), rows of the nodes of each edge.
        links: number of nearest nodes that a start or goal is linked to.
        start: (s, r, n) [rad].
        goal: (s, r, n) [rad].
        codes: (s, r, l).

    Returns:
        (s, r, l + 1, N + 1) bool; class N is the goal.
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
