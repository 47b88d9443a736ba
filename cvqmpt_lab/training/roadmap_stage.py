"""Training of sequence models on roadmap labels: shortest code sequences, and which nodes and edges
are free.

The loss of a batch is the mean cross entropy of the next code, plus the binary cross entropies of
P(code free), P(edge free) and P(link free), the latter two twice, where a model predicts them.
Links are the motions between configurations and codes near them. Every path is learned from both
ways.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import Dataset

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.training.batches import batch_seed
from cvqmpt_lab.training.dataset import VALIDATION_EVERY
from cvqmpt_lab.training.roadmap_dataset import RoadmapDataset
from cvqmpt_lab.training.stage_base import Means, OptimizerSettings, Stage
from cvqmpt_lab.training.training_clouds import CloudSettings, sample_cloud
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import require_sizes
from cvqmpt_lab.vqmpt.scene_arrays import LONGEST, NOWHERE
from cvqmpt_lab.vqmpt.scene_transformer import roadmap_ways

NO_TARGET = -100
SHORT = (4, 6)  # codes from which paths count as longer ones
FEWEST_PATHS = 8  # of a scene that is used


@dataclass(frozen=True, kw_only=True)
class RoadmapSettings:
    """How a sequence model is trained on roadmap labels."""

    epochs: int = 30
    batches_per_epoch: int = 400
    scenes: int = 4  # of a batch
    paths: int = 96  # of each scene
    goals: int = 16  # different ones of each scene
    link_ends: int = 24  # configurations of each scene from which motions to codes are judged
    cloud: CloudSettings = field(
        default_factory=lambda: CloudSettings(points=1024, occlusion=0.3, measured=0.3)
    )
    validation_scenes: int = 70
    fine_tune: bool = False  # begin with the transformer of the dictionary's weights
    # of most matrix products; losses are always float32
    precision: Literal["float32", "bf16"] = "bf16"
    optimizer: OptimizerSettings = field(
        default_factory=lambda: OptimizerSettings(
            rate=2e-3, warmup=100, schedule="cosine", weight_decay=0.01, clip=1.0
        )
    )

    def __post_init__(self) -> None:
        names = ("batches_per_epoch", "scenes", "paths", "goals", "link_ends", "validation_scenes")
        require_sizes(**{name: getattr(self, name) for name in names})


Cloud = Mapping[str, Tensor]
"""Clouds of s scenes as a model takes them, every array (s, ...)."""


class Predicted(NamedTuple):
    """What a model says of a batch."""

    logits: Tensor  # (s, r, l + 1, classes) after every prefix; the last class is the goal
    node_odds: Tensor | None = None  # (s, N), log odds of P(code free)
    edge_odds: Tensor | None = None  # (s, E), log odds of P(edge free)
    link_odds: Tensor | None = None  # (s, k, l), log odds of P(link free)


class RoadmapBatches(Dataset):
    """Batches: scene (s,); the arrays of their clouds; node_free (s, N), edge_free (s, E) bool.

    starts (s, u, n) and goals (s, g, n) [rad], and which of them each path joins, start and goal
    (s, r); codes (s, r, l), padded with 0, and how many there are, count (s, r). Of links, link_end
    (s, k, n) [rad], link_code (s, k, l) and link_free (s, k, l) bool.
    """

    def __init__(
        self,
        dataset: RoadmapDataset,
        settings: RoadmapSettings,
        cloud_arrays: Callable[[np.ndarray], dict[str, np.ndarray]],
        scenes: np.ndarray,
        seed: tuple[int, int],
        augmented: bool = True,
    ) -> None:
        """cloud_arrays: a cloud (m, 3) as the model takes it. scenes: (batches, s) rows of the
        dataset's scenes.

        augmented: noise, hidden surfaces, both directions.
        """
        self._dataset, self._settings, self._cloud_arrays = dataset, settings, cloud_arrays
        self._scenes, self._seed, self._augmented = scenes, seed, augmented
        self._cloud = settings.cloud if augmented else settings.cloud.without_augmentation()
        self._first = np.searchsorted(dataset.path_scene, np.arange(len(dataset.scenes) + 1))
        self._count = np.diff(dataset.code_start)

    def __len__(self) -> int:
        return len(self._scenes)

    def __getitem__(self, batch: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(batch_seed(*self._seed, batch))
        scenes, dataset = self._scenes[batch], self._dataset
        of_first = slice(self._first[scenes[0]], self._first[scenes[0] + 1])
        alike = np.digitize(rng.choice(self._count[of_first]), SHORT) if self._augmented else None
        each = [self._paths(int(scene), alike, rng) for scene in scenes]
        shapes = [dataset.scenes.shapes(int(scene)) for scene in scenes]
        clouds = [
            self._cloud_arrays(sample_cloud(of_scene, self._cloud, rng)) for of_scene in shapes
        ]
        node, edge = dataset.free(scenes)
        batched = {name: _stacked([paths[name] for paths in each]) for name in each[0]}
        links = np.stack([self._links(int(scene), rng) for scene in scenes])
        return batched | {
            "scene": scenes,
            **{name: np.stack([cloud[name] for cloud in clouds]) for name in clouds[0]},
            "node_free": node,
            "edge_free": edge,
            "link_end": dataset.unpacked(dataset.link_end[links]),
            "link_code": dataset.link_code[links].astype(np.int64),
            "link_free": dataset.link_free[links],
            "codes": batched["codes"][:, :, : batched["count"].max()],
        }

    def _paths(
        self, scene: int, alike: int | None, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Paths of one scene to a few goals; alike: of about one length, so that few are padded."""
        dataset, settings = self._dataset, self._settings
        rows = np.arange(self._first[scene], self._first[scene + 1])
        rows = rows[self._count[rows] <= LONGEST]
        fitting = rows[np.digitize(self._count[rows], SHORT) == alike]
        rows = fitting if len(fitting) >= settings.paths // 6 else rows
        backwards = self._augmented and rng.random() < 0.5
        _, number = np.unique(
            dataset.ends[rows, 0 if backwards else 1], axis=0, return_inverse=True
        )
        number = number.reshape(-1)
        rows = rows[np.isin(number, rng.permutation(number.max() + 1)[: settings.goals])]
        rows = rng.choice(rows, settings.paths, replace=len(rows) < settings.paths)
        ends = dataset.configurations(rows)[:, :: -1 if backwards else 1]
        starts, start = np.unique(ends[:, 0], axis=0, return_inverse=True)
        goals, goal = np.unique(ends[:, 1], axis=0, return_inverse=True)
        count, place = self._count[rows], np.arange(LONGEST)
        inside = place < count[:, None]
        at = np.where(inside, count[:, None] - 1 - place if backwards else place, 0)
        codes = np.where(inside, dataset.codes[dataset.code_start[rows][:, None] + at], 0).astype(
            np.int64
        )
        return {
            "starts": starts,
            "goals": goals,
            "start": start.reshape(-1),
            "goal": goal.reshape(-1),
            "codes": codes,
            "count": count,
        }

    def _links(self, scene: int, rng: np.random.Generator) -> np.ndarray:
        """Rows (k,) of some of a scene's ends of links."""
        (first, last), count = self._dataset.link_start[scene : scene + 2], self._settings.link_ends
        return rng.choice(np.arange(first, last), count, replace=last - first < count)


def _stacked(arrays: list[np.ndarray]) -> np.ndarray:
    """Arrays of different lengths as one; rows of shorter ones are repeated."""
    rows = max(map(len, arrays))
    return np.stack([array[np.arange(rows) % len(array)] for array in arrays])


class RoadmapStage(Stage):
    """Training of a sequence model on roadmap labels."""

    selection = "validation_loss"
    many_processes = True

    def __init__(
        self,
        dataset: RoadmapDataset,
        dictionary: Checkpoint,
        settings: RoadmapSettings,
        links: int,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on labels of a dictionary's roadmap; links: codes that a start or goal
        leads to.

        InvalidInputError: the dictionary is of another robot, or the labels are without kinematics.
        """
        super().__init__(settings.optimizer, seed, device)
        graph, codes = dataset.graph, dictionary.config.dictionary.n_codes
        if dictionary.robot.differences(dataset.robot) or len(graph.nodes) != codes:
            raise InvalidInputError(
                f"{dataset.folder} labels the roadmap of a dictionary of robot "
                f"{dataset.robot.name!r} with "
                f"{len(graph.nodes)} codes, but this one is of {dictionary.robot.name!r} with "
                f"{codes}; give "
                "--dictionary DIR, the same as to cvqmpt data generate"
            )
        if dataset.chain is None:
            raise InvalidInputError(
                f"{dataset.folder} has no kinematics; generate its labels again"
            )
        self.dataset, self.dictionary, self.settings, self._links = (
            dataset,
            dictionary,
            settings,
            links,
        )
        count = np.bincount(dataset.path_scene, minlength=len(dataset.scenes))
        usable = count >= FEWEST_PATHS
        validates = dataset.scenes.seed % VALIDATION_EVERY == 0
        self._train, self._held_out = (
            np.flatnonzero(usable & ~validates),
            np.flatnonzero(usable & validates),
        )

    def require_splits(self) -> Self:
        """Raise InvalidInputError where the labels are few."""
        scenes = self.settings.scenes
        if len(self._train) < scenes or len(self._held_out) < scenes:
            raise InvalidInputError(
                f"{self.dataset.folder} has {len(self._train)} scenes to train on and "
                f"{len(self._held_out)} to "
                f"validate with; generate {scenes * VALIDATION_EVERY} scenes at least"
            )
        return self

    @abstractmethod
    def cloud_arrays(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """A cloud (m, 3) [m] as the model takes it."""

    @abstractmethod
    def predict(self, cloud: Cloud, batch: dict[str, Tensor]) -> Predicted:
        """What the model says of a batch's paths, with these clouds."""

    def free_shares(self) -> list[Tensor]:
        """Log odds of how often each code (N,) and edge (E,) is free."""
        rows = self._train[:: max(1, len(self._train) // 2000)]
        shares = (torch.from_numpy(free.mean(axis=0)).float() for free in self.dataset.free(rows))
        return [torch.logit(share.clamp(0.01, 0.99)) for share in shares]

    def batches(self, epoch: int) -> RoadmapBatches:
        """Scenes in a random order."""
        rng = np.random.default_rng((self.seed, epoch))
        wanted = self.settings.batches_per_epoch * self.settings.scenes
        repeats = -(-wanted // len(self._train))
        scenes = np.concatenate([rng.permutation(self._train) for _ in range(repeats)])[:wanted]
        scenes = scenes.reshape(-1, self.settings.scenes)
        return RoadmapBatches(
            self.dataset, self.settings, self.cloud_arrays, scenes, (self.seed, epoch)
        )

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Cross entropy of the next code, and of what is free."""
        with torch.autocast(
            self.device.type, torch.bfloat16, enabled=self.settings.precision == "bf16"
        ):
            logits, node_odds, edge_odds, link_odds = self.predict(batch, batch)
        targets = self.targets(batch, logits.shape[-1] - 1)
        code = F.cross_entropy(
            logits.flatten(0, 2).float(), targets.flatten(), ignore_index=NO_TARGET
        )
        if node_odds is None or edge_odds is None:
            return {"loss": code, "code": code}
        node = F.binary_cross_entropy_with_logits(node_odds, batch["node_free"].float())
        edge = F.binary_cross_entropy_with_logits(edge_odds, batch["edge_free"].float())
        found = {"loss": code + node + 2.0 * edge, "code": code, "node": node, "edge": edge}
        if link_odds is not None:
            found["link"] = F.binary_cross_entropy_with_logits(
                link_odds, batch["link_free"].float()
            )
            found["loss"] = found["loss"] + 2.0 * found["link"]
        return found

    @staticmethod
    def targets(batch: dict[str, Tensor], goal: int) -> Tensor:
        """Next codes (s, r, l + 1) int64: class `goal` after the last, NO_TARGET behind it."""
        codes, count = batch["codes"], batch["count"][..., None]
        step = torch.arange(codes.shape[2] + 1, device=codes.device)
        following = F.pad(codes, (0, 1)).masked_fill(step == count, goal)
        return following.masked_fill(step > count, NO_TARGET)

    def validate(self) -> dict[str, float | None]:
        """Means on held-out scenes: with their own cloud, that of another scene, and none."""
        return self.measured(self._held_out[: self.settings.validation_scenes])

    def measured(
        self, rows: np.ndarray, other: np.ndarray | None = None
    ) -> dict[str, float | None]:
        """The same in scenes `rows`; other (m, 3):
        the cloud of another scene, None for the next one of a batch.
        """
        rows = rows[: len(rows) // self.settings.scenes * self.settings.scenes].reshape(
            -1, self.settings.scenes
        )
        batches = RoadmapBatches(
            self.dataset, self.settings, self.cloud_arrays, rows, (self.seed, 0), augmented=False
        )
        means = Means()
        for number in range(len(batches)):
            batch = {
                name: torch.from_numpy(array).to(self.device)
                for name, array in batches[number].items()
            }
            self._measure(means, batch, other)
        return means.values()

    def _everywhere(self, points: np.ndarray, batch: dict[str, Tensor]) -> Cloud:
        """One cloud for all scenes of a batch."""
        arrays = self.cloud_arrays(points)
        return {
            n: torch.from_numpy(a).to(self.device).expand_as(batch[n]) for n, a in arrays.items()
        }

    def _measure(self, means: Means, batch: dict[str, Tensor], other: np.ndarray | None) -> None:
        start, goal = (chosen(batch[f"{end}s"], batch[end]) for end in ("start", "goal"))
        graph = self.dataset.graph
        roadmap = (
            torch.from_numpy(graph.nodes).float(),
            torch.from_numpy(graph.edges.astype(np.int64)),
        )
        nodes, edges = (part.to(self.device) for part in roadmap)
        ways = roadmap_ways(nodes, edges, self._links, start, goal, batch["codes"])
        nowhere = np.tile(np.array(NOWHERE, dtype=np.float32), (self.settings.cloud.points, 1))
        none = self._everywhere(nowhere, batch)
        rolled = {name: batch[name].roll(1, 0) for name in none}
        clouds: dict[str, Cloud] = {
            "": batch,
            "wrong_cloud_": rolled if other is None else self._everywhere(other, batch),
            "no_cloud_": none,
        }
        for prefix, given in clouds.items():
            logits, *dense = self.predict(given, batch)
            targets = self.targets(batch, logits.shape[-1] - 1).flatten()
            extra = ways.new_zeros(*ways.shape[:-1], logits.shape[-1] - ways.shape[-1])
            allowed = torch.cat((ways[..., :-1], extra, ways[..., -1:]), -1)
            for which, odds in (
                ("all", logits),
                ("ways", logits.masked_fill(~allowed, -torch.inf)),
            ):
                each = F.cross_entropy(
                    odds.flatten(0, 2), targets, ignore_index=NO_TARGET, reduction="none"
                )
                counted = each[(targets != NO_TARGET) & each.isfinite()]
                means.add(f"{prefix}cross_entropy_{which}", float(counted.sum()), len(counted))
            if prefix == "":
                means.add("loss", float(counted.sum()), len(counted))
                for name, predicted in zip(("node", "edge", "link"), dense, strict=True):
                    if predicted is not None:
                        each_scene = zip(
                            predicted.flatten(1), batch[f"{name}_free"].flatten(1), strict=True
                        )
                        found = (area_under_curve(o, f) for o, f in each_scene)
                        areas = [area for area in found if area is not None]
                        means.add(f"{name}_area_under_curve", sum(areas), len(areas))


def chosen(values: Tensor, rows: Tensor) -> Tensor:
    """Of values (s, u, ...) those of rows (s, r) of each scene, (s, r, ...)."""
    return values[torch.arange(len(values), device=values.device)[:, None], rows]


def area_under_curve(odds: Tensor, free: Tensor) -> float | None:
    """How often a free one has higher odds (b,) than one that is not; None where all are alike."""
    good, bad = odds[free], odds[~free]
    if not len(good) or not len(bad):
        return None
    rank = torch.cat((good, bad)).argsort().argsort().double() + 1.0
    return float(
        (rank[: len(good)].sum() - len(good) * (len(good) + 1) / 2) / (len(good) * len(bad))
    )
