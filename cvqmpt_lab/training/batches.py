"""Batches of scenes with equally many paths each, for stage 2 and MPNet;
turns of robot and scene about the base.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from torch.utils.data import Dataset

from cvqmpt_lab.training.dataset import PathDataset, with_few_trivial
from cvqmpt_lab.training.shards import FULL_SCALE
from cvqmpt_lab.training.training_clouds import CloudSettings, sample_cloud
from cvqmpt_lab.vqmpt.config import require_sizes

# added to least + most of a path's first joint u, by which paths of a scene are grouped
SIDE_NOISE = 0.4


@dataclass(frozen=True, kw_only=True)
class SceneBatchSettings:
    """What a batch is made of."""

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
    """The only source of randomness of a batch."""
    return np.random.SeedSequence((seed, epoch, batch))


class BaseTurn:
    """Turns of robot and scene about the base within the first joint's limits;
    all 0 unless `active`.
    """

    def __init__(self, dataset: PathDataset, wanted: bool) -> None:
        self.active = wanted and dataset.chain is not None and dataset.chain.turns_about_base
        self._range = np.float64(dataset.robot.upper[0] - dataset.robot.lower[0])
        first, starts = dataset.paths.waypoints[:, 0], dataset.paths.start[:-1]
        ends = [
            f.reduceat(first, starts) if len(starts) else np.empty(0)
            for f in (np.minimum, np.maximum)
        ]
        # (p,) of the first joint along each path
        self.least, self.most = (end / FULL_SCALE for end in ends)

    def draw(self, paths: np.ndarray, rng: np.random.Generator) -> float:
        """One angle [rad] for all of these paths together."""
        place = rng.random(2)[0]  # two draws, as in the trainings of the shipped weights
        least, most = self.least[paths].min(), self.most[paths].max()
        return float((-least + place * (1.0 - most + least)) * self._range) if self.active else 0.0

    def draw_each(self, paths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Shifts of the normalised first joint (b,), one for each of these paths."""
        place = rng.random(len(paths))
        shift = -self.least[paths] + place * (1.0 - self.most[paths] + self.least[paths])
        return shift if self.active else np.zeros(len(paths))

    def joints(self, u: np.ndarray, angle: float) -> np.ndarray:
        """Turn normalised joints u (..., n) by an angle [rad]."""
        u = np.array(u, dtype=np.float32)
        u[..., 0] += np.float32(angle / self._range)
        return u


def turned(cloud: np.ndarray, angle: float) -> np.ndarray:
    """A cloud (k, 3) turned with its scene by an angle [rad] about z."""
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)), dtype=np.float32)  # transposed
    return cloud @ turn


def grouped_by_scene(
    dataset: PathDataset,
    rows: np.ndarray,
    size: int,
    rng: np.random.Generator,
    key: np.ndarray | None = None,
) -> np.ndarray:
    """Shuffle paths into groups (g, size) of one scene each, groups shuffled; -1 fills a group up.

    Within a scene, paths of similar `key` (p,), one number for every path of the dataset, come
    together.
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
    """How many equal values stand directly before each."""
    begins = np.flatnonzero(np.concatenate(([True], values[1:] != values[:-1])))
    return np.arange(len(values)) - begins.repeat(np.diff(np.append(begins, len(values))))


class SceneBatches(Dataset):
    """Dictionaries: scene (s,); cloud (s, points, 3) [m];
    u (s p, t, n), counts and weight (s p,), grouped by scene.
    """

    def __init__(
        self,
        dataset: PathDataset,
        settings: SceneBatchSettings,
        turn: BaseTurn | None,
        groups: list[np.ndarray],
        seed: tuple[int, int],
    ) -> None:
        """Batches of groups, one list element a batch;
        without turns, for validation, clouds are not augmented.
        """
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
        """Every training path once, in an order of its own for each epoch."""
        rng = np.random.default_rng((seed, epoch))
        rows = with_few_trivial(dataset.paths, dataset.split("train"), settings.trivial_share, rng)
        key = None
        if turn.active:  # paths on the same side of the robot can be turned further together
            key = turn.least + turn.most + rng.uniform(0.0, SIDE_NOISE, len(dataset.paths))
        groups = grouped_by_scene(dataset, rows, settings.paths_per_scene, rng, key)
        count = max(1, len(groups) // settings.scenes)
        groups = groups[: max(count * settings.scenes, 1)]
        batches = np.array_split(groups, count)[: settings.batches_per_epoch]
        return cls(dataset, settings, turn, batches, (seed, epoch))

    @classmethod
    def for_validation(
        cls, dataset: PathDataset, settings: SceneBatchSettings, seed: int
    ) -> "SceneBatches":
        """Held-out paths, always the same ones and the same clouds;
        scenes of a batch differ where they can.
        """
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
    """For each entry the place of the next one of another scene; None when all are of one scene."""
    if (scene == scene[0]).all():
        return None
    count = len(scene)
    cycle = (np.arange(count)[:, None] + np.arange(count)) % count
    return cycle[np.arange(count), (scene[cycle] != scene[:, None]).argmax(1)]
