"""Batches of scenes with equally many paths or code sequences each; turns about the base."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from torch.utils.data import Dataset

from cvqmpt_lab.training.clouds import CloudSettings, sample_cloud
from cvqmpt_lab.training.dataset import (
    PathDataset,
    RoadmapLabels,
    SequenceDataset,
    with_few_trivial,
)
from cvqmpt_lab.training.shards import FULL_SCALE
from cvqmpt_lab.training.stage import OptimizerSettings
from cvqmpt_lab.vqmpt.config import require_sizes


@dataclass(frozen=True, kw_only=True)
class SceneBatchSettings:
    """Amounts and augmentation of a batch of paths."""

    scenes: int = 16
    paths_per_scene: int = 4  # a scene with fewer paths repeats one with weight 0
    batches_per_epoch: int | None = None  # at most; None for all paths
    spacing: float | None = None  # of waypoints along a path [rad]; None to take all
    trivial_share: float = 0.15  # of paths whose straight line is free, at most
    turn_base: bool = False  # turn scene and paths alike about the base
    cloud: CloudSettings = field(default_factory=CloudSettings)
    validation_paths: int = 512  # at most

    def __post_init__(self) -> None:
        names = ("scenes", "paths_per_scene", "batches_per_epoch")
        require_sizes(**{name: getattr(self, name) for name in names})


def batch_seed(seed: int, epoch: int, batch: int) -> np.random.SeedSequence:
    """Seed of a batch, the only source of its randomness."""
    return np.random.SeedSequence((seed, epoch, batch))


class BaseTurn:
    """Rotations of robot and scene about the base, within the limits of joint 1 if `active`."""

    def __init__(self, dataset: PathDataset, wanted: bool) -> None:
        self.active = wanted and dataset.chain is not None and dataset.chain.turns_about_base
        self._range = np.float64(dataset.robot.upper[0] - dataset.robot.lower[0])
        first, starts = dataset.paths.waypoints[:, 0], dataset.paths.start[:-1]
        # (p,) of the first joint along each path
        self.least = np.minimum.reduceat(first, starts) / FULL_SCALE
        self.most = np.maximum.reduceat(first, starts) / FULL_SCALE

    def draw(self, paths: np.ndarray, rng: np.random.Generator) -> float:
        """One angle [rad] that keeps joint 1 of all these paths within its limits."""
        # two draws, as in the trainings of the shipped weights
        place = rng.random(2)[0]
        least, most = self.least[paths].min(), self.most[paths].max()
        return float((-least + place * (1.0 - most + least)) * self._range) if self.active else 0.0

    def draw_each(self, paths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Shifts (b,) of the normalised first joint that keep each path within its limits."""
        place = rng.random(len(paths))
        # u_1 + shift is uniform over what leaves the whole path within the limits
        shift = -self.least[paths] + place * (1.0 - self.most[paths] + self.least[paths])
        return shift if self.active else np.zeros(len(paths))

    def joints(self, u: np.ndarray, angle: float) -> np.ndarray:
        """Turn normalised joints u (..., n): u_1 <- u_1 + angle / (upper_1 - lower_1)."""
        u = np.array(u, dtype=np.float32)
        u[..., 0] += np.float32(angle / self._range)
        return u


def turned(cloud: np.ndarray, angle: float) -> np.ndarray:
    """Rotate a cloud (k, 3) about z by an angle [rad]: p <- Rz(angle) p."""
    c, s = math.cos(angle), math.sin(angle)
    transposed = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)), dtype=np.float32)
    return cloud @ transposed


def grouped_by_scene(
    dataset: PathDataset,
    rows: np.ndarray,
    size: int,
    rng: np.random.Generator,
    key: np.ndarray | None = None,
) -> np.ndarray:
    """Shuffle paths into groups of one scene each, groups shuffled.

    Args:
        dataset: of p paths.
        rows: (k,) the paths to group.
        size: of a group.
        rng: draws the order.
        key: (p,) a number for every path; within a scene, paths of similar ones come together.

    Returns:
        Groups (g, size) of rows; -1 fills a group up.
    """
    rows = rng.permutation(rows)
    scenes = dataset.paths.scene[rows]
    order = np.argsort(scenes, kind="stable") if key is None else np.lexsort((key[rows], scenes))
    rows, scenes = rows[order], scenes[order]
    inside = _place_in_run(scenes)
    group = np.cumsum(inside % size == 0) - 1
    groups = np.full((group[-1] + 1, size), -1, dtype=np.int64)
    groups[group, inside % size] = rows
    return rng.permutation(groups)


def _place_in_run(values: np.ndarray) -> np.ndarray:
    """For each entry, the number of equal entries directly before it."""
    begins = np.flatnonzero(np.concatenate(([True], values[1:] != values[:-1])))
    return np.arange(len(values)) - begins.repeat(np.diff(np.append(begins, len(values))))


class SceneBatches(Dataset):
    """Batches of s scenes with p paths each.

    Arrays: scene (s,), cloud (s, points, 3) [m], u (s p, t, n), counts (s p,) of waypoints and
    weight (s p,) bool, False for paths that fill a scene up.
    """

    def __init__(
        self,
        dataset: PathDataset,
        settings: SceneBatchSettings,
        turn: BaseTurn | None,
        groups: list[np.ndarray],
        seed: tuple[int, int],
    ) -> None:
        """Take groups (g, p) for each batch; no turns means no augmentation, for validation."""
        self._dataset, self._turn, self._groups, self._seed = dataset, turn, groups, seed
        self._cloud = settings.cloud if turn is not None else settings.cloud.without_augmentation()

    @classmethod
    def of_epoch(
        cls,
        dataset: PathDataset,
        settings: SceneBatchSettings,
        turn: BaseTurn,
        seed: int,
        epoch: int,
    ) -> "SceneBatches":
        """Every training path once, in a new order for each epoch."""
        rng = np.random.default_rng((seed, epoch))
        rows = with_few_trivial(dataset.paths, dataset.split("train"), settings.trivial_share, rng)
        key = None
        if turn.active:
            # paths on the same side of the robot can be turned further together
            key = turn.least + turn.most + rng.uniform(0.0, 0.4, len(dataset.paths))
        groups = grouped_by_scene(dataset, rows, settings.paths_per_scene, rng, key)
        count = max(1, len(groups) // settings.scenes)
        groups = groups[: max(count * settings.scenes, 1)]
        batches = np.array_split(groups, count)[: settings.batches_per_epoch]
        return cls(dataset, settings, turn, batches, (seed, epoch))

    @classmethod
    def for_validation(
        cls, dataset: PathDataset, settings: SceneBatchSettings, seed: int
    ) -> "SceneBatches":
        """Equal held-out paths and clouds each time; scenes of a batch differ if possible."""
        rng = np.random.default_rng(seed)
        rows = with_few_trivial(
            dataset.paths, dataset.split("validation"), settings.trivial_share, rng
        )
        groups = grouped_by_scene(dataset, rows, settings.paths_per_scene, rng)
        scene = dataset.paths.scene[groups[:, 0]]
        by_scene, rank = np.argsort(scene, kind="stable"), np.empty(len(scene), dtype=np.int64)
        rank[by_scene] = _place_in_run(scene[by_scene])
        order = np.argsort(rank, kind="stable")
        groups = groups[order][: max(2, settings.validation_paths // settings.paths_per_scene)]
        family = dataset.scenes.family[dataset.paths.scene[groups[:, 0]]]
        # the other scene is mostly of the same family
        groups = groups[np.argsort(family, kind="stable")]
        count = max(1, len(groups) // settings.scenes)
        return cls(dataset, settings, None, np.array_split(groups, count), (seed, 0))

    def __len__(self) -> int:
        return len(self._groups)

    def __getitem__(self, batch: int) -> dict[str, np.ndarray]:
        groups, paths = self._groups[batch], self._dataset.paths
        rng = np.random.default_rng(batch_seed(*self._seed, batch))
        rows = np.where(groups < 0, groups[:, :1], groups)
        scenes = paths.scene[rows[:, 0]]
        angles = [0.0 if self._turn is None else self._turn.draw(group, rng) for group in rows]
        clouds = [
            sample_cloud(self._dataset.scenes.shapes(int(scene)), self._cloud, rng)
            for scene in scenes
        ]
        u, counts = paths.padded(rows.ravel())
        if self._turn is not None:
            turns = zip(u.reshape(*rows.shape, *u.shape[1:]), angles, strict=True)
            u = np.concatenate([self._turn.joints(part, angle) for part, angle in turns])
        return {
            "cloud": np.stack(
                [turned(cloud, angle) for cloud, angle in zip(clouds, angles, strict=True)]
            ),
            "u": u,
            "counts": counts,
            "weight": (groups >= 0).ravel(),
            "scene": scenes,
        }


def other_scenes(scene: np.ndarray) -> np.ndarray | None:
    """For each entry, the next index with another scene; None when all are of one scene."""
    if (scene == scene[0]).all():
        return None
    count = len(scene)
    cycle = (np.arange(count)[:, None] + np.arange(count)) % count
    return cycle[np.arange(count), (scene[cycle] != scene[:, None]).argmax(1)]


@dataclass(frozen=True, kw_only=True)
class RoadmapSettings:
    """How a sequence model is trained on sequences of codes."""

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


class SequenceBatches(Dataset):
    """Batches of s scenes with r code sequences each, as arrays.

    scene (s,), and the arrays of the clouds, (s, ...). starts (s, u, n) and goals (s, g, n) [rad];
    start and goal (s, r) int64: which of them each sequence joins. codes (s, r, l) int64, padded
    with 0, and count (s, r), how many there are. On a roadmap also node_free (s, N) and edge_free
    (s, E) bool, and of k ends of links link_end (s, k, n) [rad], link_code and link_free
    (s, k, LINKS).
    """

    def __init__(
        self,
        dataset: SequenceDataset,
        settings: RoadmapSettings,
        cloud_arrays: Callable[[np.ndarray], dict[str, np.ndarray]],
        scenes: np.ndarray,
        longest: int,
        seed: tuple[int, int],
        augmented: bool = True,
    ) -> None:
        """Prepare batches.

        Args:
            dataset: of s scenes.
            settings: amounts and clouds.
            cloud_arrays: makes of a cloud (m, 3) [m] what the model takes.
            scenes: (batches, s) rows of the dataset's scenes.
            longest: codes of a sequence at most; longer ones are left out.
            seed: of the training, and the epoch.
            augmented: noise, hidden surfaces, both directions.
        """
        self._dataset, self._settings, self._cloud_arrays = dataset, settings, cloud_arrays
        self._scenes, self._longest, self._seed = scenes, longest, seed
        self._augmented = augmented
        self._cloud = settings.cloud if augmented else settings.cloud.without_augmentation()
        self._first = np.searchsorted(dataset.path_scene, np.arange(len(dataset.scenes) + 1))
        self._count = np.diff(dataset.code_start)

    def __len__(self) -> int:
        return len(self._scenes)

    def __getitem__(self, batch: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(batch_seed(*self._seed, batch))
        scenes, dataset = self._scenes[batch], self._dataset
        of_first = slice(self._first[scenes[0]], self._first[scenes[0] + 1])
        drawn = rng.choice(self._count[of_first]) if self._augmented else None
        each = [self._sequences(int(scene), drawn, rng) for scene in scenes]
        found = {name: _stacked([one[name] for one in each]) for name in each[0]}
        found["codes"] = found["codes"][:, :, : found["count"].max()]
        found["scene"] = scenes
        clouds = []
        for scene in scenes:
            cloud = sample_cloud(dataset.scenes.shapes(int(scene)), self._cloud, rng)
            clouds.append(self._cloud_arrays(cloud))
        found |= {name: np.stack([cloud[name] for cloud in clouds]) for name in clouds[0]}
        if dataset.roadmap is not None:
            found |= self._roadmap_arrays(dataset.roadmap, scenes, rng)
        return found

    def _sequences(
        self, scene: int, length: int | None, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Sequences of one scene; of about this length, if given, so that few are padded."""
        dataset, settings = self._dataset, self._settings
        rows = np.arange(self._first[scene], self._first[scene + 1])
        rows = rows[self._count[rows] <= self._longest]
        if length is not None:
            # lengths below 4, below 6 and others are about one
            alike = np.digitize(self._count[rows], (4, 6)) == np.digitize(length, (4, 6))
            rows = rows[alike] if alike.sum() >= settings.paths // 6 else rows
        backwards = self._augmented and rng.random() < 0.5
        goals = dataset.ends[rows, 0 if backwards else 1]
        _, number = np.unique(goals, axis=0, return_inverse=True)
        number = number.reshape(-1)
        # each goal costs the scene transformer an evaluation, but nothing without a roadmap
        most = settings.paths if dataset.roadmap is None else settings.goals
        rows = rows[np.isin(number, rng.permutation(number.max() + 1)[:most])]
        rows = rng.choice(rows, settings.paths, replace=len(rows) < settings.paths)
        ends = dataset.configurations(dataset.ends[rows])[:, :: -1 if backwards else 1]
        starts, start = np.unique(ends[:, 0], axis=0, return_inverse=True)
        goals, goal = np.unique(ends[:, 1], axis=0, return_inverse=True)
        count, place = self._count[rows], np.arange(self._longest)
        inside = place < count[:, None]
        at = np.where(inside, count[:, None] - 1 - place if backwards else place, 0)
        codes = dataset.codes[dataset.code_start[rows][:, None] + at]
        return {
            "starts": starts,
            "goals": goals,
            "start": start.reshape(-1),
            "goal": goal.reshape(-1),
            "codes": np.where(inside, codes, 0).astype(np.int64),
            "count": count,
        }

    def _roadmap_arrays(
        self, roadmap: RoadmapLabels, scenes: np.ndarray, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """Which nodes and edges are free in scenes (s,), and some of the scenes' links."""
        rows, wanted = [], self._settings.link_ends
        for scene in scenes:
            first, last = roadmap.link_start[scene : scene + 2]
            rows.append(rng.choice(np.arange(first, last), wanted, replace=last - first < wanted))
        links = np.stack(rows)
        node_free, edge_free = roadmap.free(scenes)
        return {
            "node_free": node_free,
            "edge_free": edge_free,
            "link_end": self._dataset.configurations(roadmap.link_end[links]),
            "link_code": roadmap.link_code[links].astype(np.int64),
            "link_free": roadmap.link_free[links],
        }


def _stacked(arrays: list[np.ndarray]) -> np.ndarray:
    """Stack arrays of different lengths; shorter ones repeat their rows."""
    rows = max(map(len, arrays))
    return np.stack([array[np.arange(rows) % len(array)] for array in arrays])
