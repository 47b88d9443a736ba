"""Batches of scenes with equally many paths each: what stage 2 and MPNet train on."""

from dataclasses import dataclass, field

import numpy as np
from torch.utils.data import Dataset

from cvqmpt_lab.training.augmentation import BaseTurn, turned
from cvqmpt_lab.training.dataset import PathDataset
from cvqmpt_lab.training.paths import with_few_trivial
from cvqmpt_lab.training.point_clouds import CloudSettings, sample_cloud
from cvqmpt_lab.vqmpt.config import require_sizes

_SIDE_NOISE = 0.4
"""Of twice the middle of a path's first joint, normalised, by which paths of a scene are grouped."""


@dataclass(frozen=True, kw_only=True)
class SceneBatchSettings:
    """What a batch is made of."""

    scenes: int = 16
    paths_per_scene: int = 4
    """A scene with fewer paths repeats one with weight 0."""
    batches_per_epoch: int | None = None
    """At most; None for all paths."""
    spacing: float | None = None
    """Of waypoints along a path [rad]; None to take all."""
    trivial_share: float = 0.15
    """Of paths whose straight line is free, at most."""
    turn_base: bool = False
    """Turn scene and paths alike about the base."""
    cloud: CloudSettings = field(default_factory=CloudSettings)
    validation_paths: int = 512
    """At most."""

    def __post_init__(self) -> None:
        require_sizes(
            scenes=self.scenes,
            paths_per_scene=self.paths_per_scene,
            batches_per_epoch=self.batches_per_epoch,
        )


def batch_seed(seed: int, epoch: int, batch: int) -> np.random.SeedSequence:
    """The only source of randomness of a batch."""
    return np.random.SeedSequence((seed, epoch, batch))


def grouped_by_scene(
    dataset: PathDataset,
    rows: np.ndarray,
    size: int,
    rng: np.random.Generator,
    key: np.ndarray | None = None,
) -> np.ndarray:
    """Shuffle paths into groups (g, size) of one scene each, groups shuffled; -1 fills a group up.

    Within a scene, paths of similar `key` (p,), one number for every path of the dataset, come together.
    """
    rows = rng.permutation(rows)
    scenes = dataset.paths.scene[rows]
    order = np.argsort(scenes, kind="stable") if key is None else np.lexsort((key[rows], scenes))
    rows, scenes = rows[order], scenes[order]
    begins = np.flatnonzero(np.concatenate(([True], scenes[1:] != scenes[:-1])))
    inside = np.arange(len(rows)) - begins.repeat(np.diff(np.append(begins, len(rows))))
    group = np.cumsum(inside % size == 0) - 1
    groups = np.full((group[-1] + 1, size), -1, dtype=np.int64)
    groups[group, inside % size] = rows
    return rng.permutation(groups)


class SceneBatches(Dataset):
    """Batches as dictionaries of arrays.

    scene (s,); cloud (s, points, 3) [m]; u (s p, t, n), counts (s p,), weight (s p,) bool. Paths are grouped by scene.
    """

    def __init__(
        self,
        dataset: PathDataset,
        settings: SceneBatchSettings,
        turn: BaseTurn | None,
        groups: list[np.ndarray],
        seed: tuple[int, int],
    ) -> None:
        """Batches of groups, one list element a batch; without turns, for validation, clouds are plain, too.

        seed: of the training, and the epoch.
        """
        self._dataset, self._settings, self._turn = dataset, settings, turn
        self._groups, self._seed = groups, seed
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
        """Every training path once, in an order of its own for each epoch."""
        rng = np.random.default_rng((seed, epoch))
        rows = with_few_trivial(dataset.paths, dataset.split("train"), settings.trivial_share, rng)
        key = None
        if turn.active:  # paths on the same side of the robot can be turned further together
            key = turn.least + turn.most + rng.uniform(0.0, _SIDE_NOISE, len(dataset.paths))
        groups = grouped_by_scene(dataset, rows, settings.paths_per_scene, rng, key)
        count = max(1, len(groups) // settings.scenes)
        groups = groups[: max(count * settings.scenes, 1)]
        batches = np.array_split(groups, count)[: settings.batches_per_epoch]
        return cls(dataset, settings, turn, batches, (seed, epoch))

    @classmethod
    def for_validation(cls, dataset: PathDataset, settings: SceneBatchSettings, seed: int) -> "SceneBatches":
        """Held-out paths, always the same ones and the same clouds; scenes of a batch differ where they can."""
        rng = np.random.default_rng(seed)
        rows = with_few_trivial(dataset.paths, dataset.split("validation"), settings.trivial_share, rng)
        groups = grouped_by_scene(dataset, rows, settings.paths_per_scene, rng)
        order = np.argsort(_rank_in_scene(dataset.paths.scene[groups[:, 0]]), kind="stable")
        groups = groups[order][: max(2, settings.validation_paths // settings.paths_per_scene)]
        family = dataset.scenes.family[dataset.paths.scene[groups[:, 0]]]
        groups = groups[np.argsort(family, kind="stable")]  # a wrong cloud is mostly of the same family
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
        clouds = [sample_cloud(self._dataset.scenes.shapes(int(scene)), self._cloud, rng) for scene in scenes]
        u, counts = paths.padded(rows.ravel())
        if self._turn is not None:
            turns = zip(u.reshape(*rows.shape, *u.shape[1:]), angles, strict=True)
            u = np.concatenate([self._turn.joints(part, angle) for part, angle in turns])
        return {
            "cloud": np.stack([turned(cloud, angle) for cloud, angle in zip(clouds, angles, strict=True)]),
            "u": u,
            "counts": counts,
            "weight": (groups >= 0).ravel(),
            "scene": scenes,
        }


def other_scenes(scene: np.ndarray) -> np.ndarray | None:
    """For each entry the place of the next one of another scene; None when all are of one scene."""
    if (scene == scene[0]).all():
        return None
    count = len(scene)
    cycle = (np.arange(count)[:, None] + np.arange(count)) % count
    return cycle[np.arange(count), (scene[cycle] != scene[:, None]).argmax(1)]


def _rank_in_scene(scenes: np.ndarray) -> np.ndarray:
    """How many earlier entries have the same scene."""
    order = np.argsort(scenes, kind="stable")
    begins = np.flatnonzero(np.concatenate(([True], scenes[order][1:] != scenes[order][:-1])))
    rank = np.empty(len(scenes), dtype=np.int64)
    rank[order] = np.arange(len(scenes)) - begins.repeat(np.diff(np.append(begins, len(scenes))))
    return rank
