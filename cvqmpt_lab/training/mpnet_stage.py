"""Training of MPNet, which proposes the next waypoint q_(t+1) from q_t, goal and encoded cloud z.

The loss is the mean of (g(q_t, q_goal, z) - q_(t+1))^2 over joints and over all steps of all paths
of a batch, in both directions; the published code uses only some of them. A batch has equally many
paths of each scene.
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
from cvqmpt_lab.vqmpt.config import MPNetConfig, Positive, Share, Size


class MPNet(nn.Module):
    """q_(t+1) = g(q_t, q_goal, z) with z = e(cloud); g and e are perceptrons with PReLU.

    Configurations are normalised to [-1, 1]; in VQ-MPT to [0, 1].
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
        """Encode clouds (b, n_points, 3) [m], points in any order, to codes (b, code_dim)."""
        return self.encoder(points.flatten(1))

    def forward(
        self, current: Tensor, goal: Tensor, code: Tensor, *, stochastic: bool = True
    ) -> Tensor:
        """Propose the next configuration; `vqmpt.mpnet_rollouts` does the same in numpy.

        Args:
            current: (b, joint_dim), q_t, normalised to [-1, 1].
            goal: (b, joint_dim), likewise.
            code: (b, code_dim), z of `encode`.
            stochastic: use dropout, as in training.

        Returns:
            (b, joint_dim), not clipped.
        """
        share = self.config.dropout
        x = torch.cat((code, current, goal), dim=-1)
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
    paths_per_scene: Size = 4  # if a scene has fewer paths, one repeats with weight 0
    batches_per_epoch: Size | None = None  # maximum number; None for all paths
    spacing: Positive | None = None  # distance of waypoints along a path [rad]; None for all
    trivial_share: Share = 0.15  # maximum share of paths whose straight line is free
    turn_base: bool = False  # whether scene and paths are rotated about the base at random
    cloud: CloudSettings = field(default_factory=CloudSettings)
    validation_paths: Size = 512  # maximum number


@dataclass(frozen=True, kw_only=True)
class MPNetSettings:
    """How MPNet is trained; clouds must have the number of points that the network takes."""

    epochs: Size = 20
    batches: SceneBatchSettings = field(default_factory=lambda: SceneBatchSettings(spacing=0.5))
    optimizer: OptimizerSettings = field(default_factory=lambda: OptimizerSettings(rate=3e-4))


class MPNetStage(Stage):
    """Training of an `MPNet`.

    A batch has s scenes with p paths each. Its arrays are scene (s,), cloud (s, points, 3) [m],
    u (s p, t, n), counts (s p,), the numbers of waypoints, and weight (s p,) bool, False for paths
    that are repeated because a scene has fewer than p.
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
        """Prepare to train on a dataset.

        Args:
            dataset: paths.
            config: sizes of the network.
            settings: how to train.
            seed: seed of all random numbers.
            device: device to train on.

        Raises:
            InvalidInputError: there are no paths for training or none for validation.
        """
        super().__init__(settings.optimizer, seed, device)
        dataset.require_splits()
        self.dataset, self.settings = dataset.thinned(settings.batches.spacing), settings.batches
        self._turn = BaseTurn(self.dataset, self.settings.turn_base)
        self.network = MPNet(config).to(device)

    def batches(self, epoch: int) -> Batches:
        """Return batches of all training paths, each path once, in a new order for each epoch."""
        turn = self._turn
        rng = np.random.default_rng((self.seed, epoch))
        rows = self.dataset.with_few_trivial(
            self.dataset.split("train"), self.settings.trivial_share, rng
        )
        key = None
        if turn.active:
            # paths with similar values of joint 1 can be rotated further together
            key = turn.least + turn.most + rng.uniform(0.0, 0.4, len(turn.least))
        groups = self._grouped(rows, rng, key)
        count = max(1, len(groups) // self.settings.scenes)
        batches = np.array_split(groups[: count * self.settings.scenes], count)
        make = partial(self._batch, augmented=True)
        return Batches(batches[: self.settings.batches_per_epoch], make, self.seed, epoch)

    def validation_batches(self) -> Batches:
        """Return batches of held-out paths, with the same paths and clouds at each call."""
        settings = self.settings
        rng = np.random.default_rng(self.seed)
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
        """Divide paths into random groups of the same scene, in random order.

        Args:
            rows: (k,), the paths.
            rng: random numbers.
            key: a number for each path of the dataset; within a scene, paths with similar numbers
                get into the same group. None for random groups.

        Returns:
            Groups (g, paths_per_scene) of rows, padded with -1.
        """
        size = self.settings.paths_per_scene
        rows = rng.permutation(rows)
        scenes = self.dataset.arrays["path_scene"][rows]
        keys = (scenes,) if key is None else (key[rows], scenes)
        order = np.lexsort(keys)
        rows, scenes = rows[order], scenes[order]
        # index of each path within its scene
        inside = np.arange(len(rows)) - np.searchsorted(scenes, scenes)
        group = np.cumsum(inside % size == 0) - 1
        groups = np.full((group[-1] + 1, size), -1, dtype=np.int64)
        groups[group, inside % size] = rows
        return rng.permutation(groups)

    def _batch(
        self, groups: np.ndarray, rng: np.random.Generator, *, augmented: bool
    ) -> dict[str, np.ndarray]:
        """Return the arrays of a batch.

        Args:
            groups: (s, p), rows of the paths, padded with -1.
            rng: random numbers.
            augmented: use noise, hidden surfaces and rotations about the base.
        """
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
        """Compute the loss of the module's docstring."""
        return {"loss": self._squared_error(batch, stochastic=True)}

    def validate(self) -> dict[str, float | None]:
        """Compute the loss on held-out scenes, without dropout."""
        errors = [
            float(self._squared_error(batch, stochastic=False))
            for batch in map(self.tensors, self.validation_batches())
        ]
        return {"squared_error": sum(errors) / len(errors)}

    def checkpoint(self, metadata: Mapping[str, Any]) -> Checkpoint:
        """Return the network with its present weights."""
        modules = {"mpnet": self.network}
        return Checkpoint(self.network.config, self.dataset.robot, modules, metadata)

    def _squared_error(self, batch: dict[str, Tensor], *, stochastic: bool) -> Tensor:
        states, counts = 2.0 * batch["u"] - 1.0, batch["counts"]
        codes = self.network.encode(batch["cloud"])
        codes = codes.repeat_interleave(len(states) // len(codes), 0)
        step = torch.arange(states.shape[1] - 1, device=states.device)
        counted = (step < counts[:, None] - 1) & batch["weight"][:, None]
        rows, place = counted.nonzero(as_tuple=True)
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
    """Rotate a cloud (k, 3) about the z axis by an angle [rad]: p <- Rz(angle) p."""
    c, s = math.cos(angle), math.sin(angle)
    transposed = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)), dtype=np.float32)
    return cloud @ transposed
