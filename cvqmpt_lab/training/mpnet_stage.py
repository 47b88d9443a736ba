"""MPNet: learn to propose the next waypoint q_(t+1) from q_t, the goal and the encoded cloud z.

The loss is the mean over all steps, both ways, and joints of |g(q_t, q_goal, z) - q_(t+1)|^2. All
examples of a batch count, unlike in the published code. A batch has as many paths of each scene.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cvqmpt_lab.training.clouds import CloudSettings, sample_cloud
from cvqmpt_lab.training.dataset import BaseTurn, PathDataset
from cvqmpt_lab.training.stage import Batches, OptimizerSettings, Stage
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import MPNetConfig, Size


class MPNet(nn.Module):
    """q_(t+1) = g(q_t, q_goal, z), z = e(cloud); g and e are perceptrons with PReLU.

    Configurations are normalised to [-1, 1], unlike in VQ-MPT.
    """

    def __init__(self, config: MPNetConfig) -> None:
        super().__init__()
        self.config = config
        encoder: list[nn.Module] = []
        widths = (3 * config.n_points, *config.encoder_widths)
        for before, after in zip(widths, config.encoder_widths, strict=False):
            encoder += [nn.Linear(before, after), nn.PReLU()]
        self.encoder = nn.Sequential(*encoder, nn.Linear(widths[-1], config.code_dim))
        widths = (config.code_dim + 2 * config.joint_dim, *config.planner_widths)
        self.hidden = nn.ModuleList(
            nn.Sequential(nn.Linear(before, after), nn.PReLU())
            for before, after in zip(widths, config.planner_widths, strict=False)
        )
        self.out = nn.Linear(widths[-1], config.joint_dim)

    def encode(self, points: Tensor) -> Tensor:
        """Codes (b, code_dim) of clouds (b, n_points, 3) [m], points in any order."""
        return self.encoder(points.flatten(1))

    def forward(
        self, current: Tensor, goal: Tensor, code: Tensor, *, stochastic: bool = True
    ) -> Tensor:
        """Propose the next configuration; planning does the same in numpy, `vqmpt.mpnet_rollouts`.

        Args:
            current: (b, joint_dim) q_t, normalised to [-1, 1].
            goal: (b, joint_dim), likewise.
            code: (b, code_dim) z, of `encode`.
            stochastic: with dropout, as in training.

        Returns:
            (b, joint_dim), not clipped.
        """
        x, share = torch.cat((code, current, goal), dim=-1), self.config.dropout
        for i, layer in enumerate(self.hidden):
            x = layer(x)
            if stochastic and share > 0.0 and i < len(self.hidden) - 1:
                kept = torch.rand(x.shape, device=x.device) >= share
                x = x * kept / (1.0 - share)
        return self.out(x)


@dataclass(frozen=True, kw_only=True)
class SceneBatchSettings:
    """Amounts and augmentation of a batch of paths."""

    scenes: Size = 16
    paths_per_scene: Size = 4  # a scene with fewer paths repeats one with weight 0
    batches_per_epoch: Size | None = None  # at most; None for all paths
    spacing: float | None = None  # of waypoints along a path [rad]; None to take all
    trivial_share: float = 0.15  # of paths whose straight line is free, at most
    turn_base: bool = False  # turn scene and paths alike about the base
    cloud: CloudSettings = field(default_factory=CloudSettings)
    validation_paths: int = 512  # at most


@dataclass(frozen=True, kw_only=True)
class MPNetSettings:
    """How MPNet is trained; clouds have as many points as its network takes."""

    epochs: int = 20
    batches: SceneBatchSettings = field(default_factory=lambda: SceneBatchSettings(spacing=0.5))
    optimizer: OptimizerSettings = field(default_factory=lambda: OptimizerSettings(rate=3e-4))


class MPNetStage(Stage):
    """Training of an `MPNet`.

    Arrays of a batch: scene (s,), cloud (s, points, 3) [m], u (s p, t, n), counts (s p,) of
    waypoints and weight (s p,) bool, False for paths that fill a scene up.
    """

    selection = "validation_squared_error"
    dataset: PathDataset

    def __init__(
        self,
        dataset: PathDataset,
        config: MPNetConfig,
        settings: MPNetSettings,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on a dataset; raises InvalidInputError where that is impossible."""
        super().__init__(settings.optimizer, seed, device)
        dataset.require_splits()
        self.dataset, self.settings = dataset.thinned(settings.batches.spacing), settings.batches
        self._turn = BaseTurn(self.dataset, self.settings.turn_base)
        self.network = MPNet(config).to(device)

    def batches(self, epoch: int) -> Batches:
        """Every training path once, in a new order for each epoch."""
        rng, turn = np.random.default_rng((self.seed, epoch)), self._turn
        rows = self.dataset.with_few_trivial(
            self.dataset.split("train"), self.settings.trivial_share, rng
        )
        key = None
        if turn.active:
            # paths on the same side of the robot can be turned further together
            key = turn.least + turn.most + rng.uniform(0.0, 0.4, len(turn.least))
        groups = self._grouped(rows, rng, key)
        count = max(1, len(groups) // self.settings.scenes)
        batches = np.array_split(groups[: count * self.settings.scenes], count)
        make = partial(self._batch, augmented=True)
        return Batches(batches[: self.settings.batches_per_epoch], make, self.seed, epoch)

    def validation_batches(self) -> Batches:
        """Equal held-out paths and clouds each time."""
        rng, settings = np.random.default_rng(self.seed), self.settings
        rows = self.dataset.with_few_trivial(
            self.dataset.split("validation"), settings.trivial_share, rng
        )
        most = max(1, settings.validation_paths // settings.paths_per_scene)
        groups = self._grouped(rows, rng)[:most]
        batches = np.array_split(groups, max(1, len(groups) // settings.scenes))
        return Batches(batches, partial(self._batch, augmented=False), self.seed, 0)

    def _grouped(
        self, rows: np.ndarray, rng: np.random.Generator, key: np.ndarray | None = None
    ) -> np.ndarray:
        """Shuffle paths into groups of one scene each, groups shuffled.

        Args:
            rows: (k,) the paths to group.
            rng: draws the order.
            key: (p,) a number for every path; within a scene, paths of similar ones come together.

        Returns:
            Groups (g, paths_per_scene) of rows; -1 fills a group up.
        """
        size, rows = self.settings.paths_per_scene, rng.permutation(rows)
        scenes = self.dataset.arrays["path_scene"][rows]
        keys = (scenes,) if key is None else (key[rows], scenes)
        order = np.lexsort(keys)
        rows, scenes = rows[order], scenes[order]
        # place of each path among those of its scene
        inside = np.arange(len(rows)) - np.searchsorted(scenes, scenes)
        group = np.cumsum(inside % size == 0) - 1
        groups = np.full((group[-1] + 1, size), -1, dtype=np.int64)
        groups[group, inside % size] = rows
        return rng.permutation(groups)

    def _batch(
        self, groups: np.ndarray, rng: np.random.Generator, *, augmented: bool
    ) -> dict[str, np.ndarray]:
        """Arrays of groups (s, p) of paths; noise, hidden surfaces and turns if augmented."""
        rows = np.where(groups < 0, groups[:, :1], groups)
        scenes = self.dataset.arrays["path_scene"][groups[:, 0]]
        angles = [self._turn.draw(group, rng) if augmented else 0.0 for group in rows]
        settings = self.settings.cloud if augmented else self.settings.cloud.without_augmentation()
        clouds = [sample_cloud(self.dataset.shapes(scene), settings, rng) for scene in scenes]
        u, counts = self.dataset.padded(rows.ravel())
        u[:, :, 0] += self._turn.shift(np.repeat(angles, rows.shape[1]))[:, None]
        return {
            "cloud": np.stack([turned(*each) for each in zip(clouds, angles, strict=True)]),
            "u": u,
            "counts": counts,
            "weight": (groups >= 0).ravel(),
            "scene": scenes,
        }

    def forward(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Mean of |g(q_t, q_goal, z) - q_(t+1)|^2 over joints, all steps and both directions."""
        return {"loss": self._squared_error(batch, batch["cloud"], stochastic=True)}

    def validate(self) -> dict[str, float | None]:
        """Loss on held-out scenes, without dropout."""
        found = [
            float(self._squared_error(batch, batch["cloud"], stochastic=False))
            for batch in map(self.tensors, self.validation_batches())
        ]
        return {"squared_error": sum(found) / len(found)}

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """The network in its present state."""
        modules = {"mpnet": self.network}
        return Checkpoint(self.network.config, self.dataset.robot, modules, metadata)

    def _squared_error(
        self, batch: dict[str, Tensor], cloud: Tensor, *, stochastic: bool
    ) -> Tensor:
        states, counts = 2.0 * batch["u"] - 1.0, batch["counts"]
        codes = self.network.encode(cloud).repeat_interleave(len(states) // len(cloud), 0)
        step = torch.arange(states.shape[1] - 1, device=states.device)
        rows, place = ((step < counts[:, None] - 1) & batch["weight"][:, None]).nonzero(
            as_tuple=True
        )
        before, after = states[rows, place], states[rows, place + 1]
        start, goal = states[rows, 0], states[rows, counts[rows] - 1]
        proposed = self.network(
            torch.cat((before, after)),
            torch.cat((goal, start)),
            codes[rows].repeat(2, 1),
            stochastic=stochastic,
        )
        return (proposed - torch.cat((after, before))).square().mean()


def turned(cloud: np.ndarray, angle: float) -> np.ndarray:
    """Rotate a cloud (k, 3) about z by an angle [rad]: p <- Rz(angle) p."""
    c, s = math.cos(angle), math.sin(angle)
    transposed = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)), dtype=np.float32)
    return cloud @ transposed
