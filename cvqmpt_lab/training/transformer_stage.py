"""Training of the scene transformer on roadmap labels: shortest code sequences, and which nodes and edges are free.

The loss of a batch is the mean cross entropy of the next code, plus the binary cross entropies of P(code free) and
P(edge free), the latter twice. Every path is learned from both ways.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

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
from cvqmpt_lab.vqmpt.config import SceneTransformerConfig, SceneTransformerSizes, require_sizes
from cvqmpt_lab.vqmpt.point_groups import NOWHERE, group_points
from cvqmpt_lab.vqmpt.scene_transformer import LONGEST, Ends, Scenes, SceneTransformer

NO_TARGET = -100
SHORT = (4, 6)  # codes from which paths count as longer ones
FEWEST_PATHS = 8  # of a scene that is used


@dataclass(frozen=True, kw_only=True)
class TransformerSettings:
    """How the scene transformer is trained."""

    epochs: int = 30
    batches_per_epoch: int = 400
    scenes: int = 4  # of a batch
    paths: int = 96  # of each scene
    goals: int = 16  # different ones of each scene
    cloud: CloudSettings = field(
        default_factory=lambda: CloudSettings(points=1024, occlusion=0.3, measured=0.3)
    )
    validation_scenes: int = 70
    precision: Literal["float32", "bf16"] = "bf16"  # of most matrix products; losses are always float32
    optimizer: OptimizerSettings = field(
        default_factory=lambda: OptimizerSettings(
            rate=2e-3, warmup=100, schedule="cosine", weight_decay=0.01, clip=1.0
        )
    )

    def __post_init__(self) -> None:
        names = ("batches_per_epoch", "scenes", "paths", "goals", "validation_scenes")
        require_sizes(**{name: getattr(self, name) for name in names})


class TransformerBatches(Dataset):
    """Batches: scene (s,); centres (s, t, 3) and offsets (s, t, m, 3) [m]; node_free (s, N), edge_free (s, E) bool.

    starts (s, u, n) and goals (s, g, n) [rad], and which of them each path joins, start and goal (s, r); codes
    (s, r, l), padded with 0, and how many there are, count (s, r).
    """

    def __init__(
        self,
        dataset: RoadmapDataset,
        settings: TransformerSettings,
        sizes: SceneTransformerSizes,
        scenes: np.ndarray,
        seed: tuple[int, int],
        augmented: bool = True,
    ) -> None:
        """scenes: (batches, s) rows of the dataset's scenes. augmented: noise, hidden surfaces, both directions."""
        self._dataset, self._settings, self._sizes = dataset, settings, sizes
        self._scenes, self._seed, self._augmented = scenes, seed, augmented
        self._cloud = settings.cloud if augmented else settings.cloud.without_augmentation()
        self._first = np.searchsorted(dataset.path_scene, np.arange(len(dataset.scenes) + 1))
        self._count = np.diff(dataset.code_start)

    def __len__(self) -> int:
        return len(self._scenes)

    def __getitem__(self, batch: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(batch_seed(*self._seed, batch))
        scenes, dataset, sizes = self._scenes[batch], self._dataset, self._sizes
        of_first = slice(self._first[scenes[0]], self._first[scenes[0] + 1])
        alike = np.digitize(rng.choice(self._count[of_first]), SHORT) if self._augmented else None
        each = [self._paths(int(scene), alike, rng) for scene in scenes]
        shapes = [dataset.scenes.shapes(int(scene)) for scene in scenes]
        groups = [
            group_points(sample_cloud(of_scene, self._cloud, rng), sizes.groups, sizes.group_size)
            for of_scene in shapes
        ]
        node, edge = dataset.free(scenes)
        batched = {name: _stacked([paths[name] for paths in each]) for name in each[0]}
        return batched | {
            "scene": scenes,
            "centres": np.stack([centres for centres, _ in groups]),
            "offsets": np.stack([offsets for _, offsets in groups]),
            "node_free": node,
            "edge_free": edge,
            "codes": batched["codes"][:, :, : batched["count"].max()],
        }

    def _paths(self, scene: int, alike: int | None, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Paths of one scene to a few goals; alike: of about one length, so that few are padded."""
        dataset, settings = self._dataset, self._settings
        rows = np.arange(self._first[scene], self._first[scene + 1])
        rows = rows[self._count[rows] <= LONGEST]
        fitting = rows[np.digitize(self._count[rows], SHORT) == alike]
        rows = fitting if len(fitting) >= settings.paths // 6 else rows
        backwards = self._augmented and rng.random() < 0.5
        _, number = np.unique(dataset.ends[rows, 0 if backwards else 1], axis=0, return_inverse=True)
        number = number.reshape(-1)
        rows = rows[np.isin(number, rng.permutation(number.max() + 1)[: settings.goals])]
        rows = rng.choice(rows, settings.paths, replace=len(rows) < settings.paths)
        ends = dataset.configurations(rows)[:, :: -1 if backwards else 1]
        starts, start = np.unique(ends[:, 0], axis=0, return_inverse=True)
        goals, goal = np.unique(ends[:, 1], axis=0, return_inverse=True)
        count, place = self._count[rows], np.arange(LONGEST)
        inside = place < count[:, None]
        at = np.where(inside, count[:, None] - 1 - place if backwards else place, 0)
        codes = np.where(inside, dataset.codes[dataset.code_start[rows][:, None] + at], 0).astype(np.int64)
        return {
            "starts": starts,
            "goals": goals,
            "start": start.reshape(-1),
            "goal": goal.reshape(-1),
            "codes": codes,
            "count": count,
        }


def _stacked(arrays: list[np.ndarray]) -> np.ndarray:
    """Arrays of different lengths as one; rows of shorter ones are repeated."""
    rows = max(map(len, arrays))
    return np.stack([array[np.arange(rows) % len(array)] for array in arrays])


class TransformerStage(Stage):
    """Training of a scene transformer."""

    selection = "validation_loss"
    many_processes = True
    module: SceneTransformer

    def __init__(
        self,
        dataset: RoadmapDataset,
        dictionary: Checkpoint,
        settings: TransformerSettings,
        sizes: SceneTransformerSizes,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on labels of a dictionary's roadmap.

        InvalidInputError: the dictionary is of another robot, or the labels are few or without kinematics.
        """
        super().__init__(settings.optimizer, seed, device)
        graph, codes = dataset.graph, dictionary.config.dictionary.n_codes
        if dictionary.robot.differences(dataset.robot) or len(graph.nodes) != codes:
            raise InvalidInputError(
                f"{dataset.folder} labels the roadmap of a dictionary of robot {dataset.robot.name!r} with "
                f"{len(graph.nodes)} codes, but this one is of {dictionary.robot.name!r} with {codes}; give "
                "--dictionary DIR, the same as to cvqmpt data generate"
            )
        if dataset.chain is None:
            raise InvalidInputError(f"{dataset.folder} has no kinematics; generate its labels again")
        self.dataset, self.dictionary, self.settings = dataset, dictionary, settings
        body = replace(dataset.chain, points=tuple(graph.body_joint.tolist()), offsets=graph.body_offset)
        self.config = SceneTransformerConfig(
            lower=dataset.robot.lower,
            upper=dataset.robot.upper,
            body=body,
            n_nodes=len(graph.nodes),
            n_edges=len(graph.edges),
            sizes=sizes,
        )
        count = np.bincount(dataset.path_scene, minlength=len(dataset.scenes))
        usable = count >= FEWEST_PATHS
        validates = dataset.scenes.seed % VALIDATION_EVERY == 0
        self._train, self._held_out = np.flatnonzero(usable & ~validates), np.flatnonzero(usable & validates)
        if len(self._train) < settings.scenes or len(self._held_out) < settings.scenes:
            raise InvalidInputError(
                f"{dataset.folder} has {len(self._train)} scenes to train on and {len(self._held_out)} to validate "
                f"with; generate {settings.scenes * VALIDATION_EVERY} scenes at least"
            )
        self.module = SceneTransformer(self.config).to(device)
        self.module.set_roadmap(graph.nodes, graph.edges)

    def prepare(self) -> None:
        """Begin with how often each code and edge is free."""
        rows = self._train[:: max(1, len(self._train) // 2000)]
        shares = (torch.from_numpy(free.mean(axis=0)).float() for free in self.dataset.free(rows))
        with torch.no_grad():
            for prior, share in zip((self.module.node_prior, self.module.edge_prior), shares, strict=True):
                prior.copy_(torch.logit(share.clamp(0.01, 0.99)))

    def batches(self, epoch: int) -> TransformerBatches:
        """Scenes in a random order."""
        rng = np.random.default_rng((self.seed, epoch))
        wanted = self.settings.batches_per_epoch * self.settings.scenes
        repeats = -(-wanted // len(self._train))
        scenes = np.concatenate([rng.permutation(self._train) for _ in range(repeats)])[:wanted]
        scenes = scenes.reshape(-1, self.settings.scenes)
        return TransformerBatches(self.dataset, self.settings, self.config.sizes, scenes, (self.seed, epoch))

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Cross entropy of the next code, and of what is free."""
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.precision == "bf16"):
            scenes = self.module.encode(batch["centres"], batch["offsets"])
            logits = self._logits(scenes, batch)
        code = F.cross_entropy(logits.flatten(0, 2), self.targets(batch).flatten(), ignore_index=NO_TARGET)
        node = F.binary_cross_entropy_with_logits(scenes.node_odds, batch["node_free"].float())
        edge = F.binary_cross_entropy_with_logits(scenes.edge_odds, batch["edge_free"].float())
        return {"loss": code + node + 2.0 * edge, "code": code, "node": node, "edge": edge}

    def _logits(self, scenes: Scenes, batch: dict[str, Tensor]) -> Tensor:
        """Logits (s, r, l + 1, N + 1) of a batch's paths in scenes."""
        starts, goals = (self.module.ends(scenes, batch[name]) for name in ("starts", "goals"))
        V = self.module.cost_to_go(scenes, goals)
        start = Ends(*(chosen(part, batch["start"]) for part in starts))
        goal = Ends(*(chosen(part, batch["goal"]) for part in goals))
        return self.module.logits(scenes, start, goal, chosen(V, batch["goal"]), batch["codes"])

    def targets(self, batch: dict[str, Tensor]) -> Tensor:
        """Next codes (s, r, l + 1) int64: N for the goal, NO_TARGET behind it."""
        codes, count = batch["codes"], batch["count"][..., None]
        step = torch.arange(codes.shape[2] + 1, device=codes.device)
        following = F.pad(codes, (0, 1)).masked_fill(step == count, self.config.n_nodes)
        return following.masked_fill(step > count, NO_TARGET)

    def validate(self) -> dict[str, float | None]:
        """Means on held-out scenes: with their own cloud, that of another scene, and none."""
        rows = self._held_out[: self.settings.validation_scenes]
        rows = rows[: len(rows) // self.settings.scenes * self.settings.scenes].reshape(
            -1, self.settings.scenes
        )
        batches = TransformerBatches(
            self.dataset, self.settings, self.config.sizes, rows, (self.seed, 0), augmented=False
        )
        means = Means()
        for number in range(len(batches)):
            batch = {name: torch.from_numpy(array).to(self.device) for name, array in batches[number].items()}
            self._measure(means, batch)
        return means.values()

    def _measure(self, means: Means, batch: dict[str, Tensor]) -> None:
        targets = self.targets(batch)
        start, goal = (chosen(batch[f"{end}s"], batch[end]) for end in ("start", "goal"))
        ways = self.module.ways(start, goal, batch["codes"])
        cloud = {name: batch[name] for name in ("centres", "offsets")}
        nowhere = torch.zeros_like(cloud["centres"]) + cloud["centres"].new_tensor(NOWHERE)
        clouds = {
            "": cloud,
            "wrong_cloud_": {name: part.roll(1, 0) for name, part in cloud.items()},
            "no_cloud_": {"centres": nowhere, "offsets": torch.zeros_like(cloud["offsets"])},
        }
        for prefix, given in clouds.items():
            scenes = self.module.encode(given["centres"], given["offsets"])
            logits = self._logits(scenes, batch)
            for which, odds in (("all", logits), ("ways", logits.masked_fill(~ways, -torch.inf))):
                each = F.cross_entropy(
                    odds.flatten(0, 2), targets.flatten(), ignore_index=NO_TARGET, reduction="none"
                )
                counted = each[(targets.flatten() != NO_TARGET) & each.isfinite()]
                means.add(f"{prefix}cross_entropy_{which}", float(counted.sum()), len(counted))
            if prefix == "":
                means.add("loss", float(counted.sum()), len(counted))
                for name, odds in (("node", scenes.node_odds), ("edge", scenes.edge_odds)):
                    each_scene = zip(odds, batch[f"{name}_free"], strict=True)
                    found = (area_under_curve(o, f) for o, f in each_scene)
                    areas = [area for area in found if area is not None]
                    means.add(f"{name}_area_under_curve", sum(areas), len(areas))

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """The dictionary with the transformer as it stands."""
        config = replace(self.dictionary.config, transformer=self.config)
        return replace(self.dictionary, config=config, transformer=self.module, metadata=metadata)


def chosen(values: Tensor, rows: Tensor) -> Tensor:
    """Of values (s, u, ...) those of rows (s, r) of each scene, (s, r, ...)."""
    return values[torch.arange(len(values), device=values.device)[:, None], rows]


def area_under_curve(odds: Tensor, free: Tensor) -> float | None:
    """How often a free one has higher odds (b,) than one that is not; None where all are alike."""
    good, bad = odds[free], odds[~free]
    if not len(good) or not len(bad):
        return None
    rank = torch.cat((good, bad)).argsort().argsort().double() + 1.0
    return float((rank[: len(good)].sum() - len(good) * (len(good) + 1) / 2) / (len(good) * len(bad)))
