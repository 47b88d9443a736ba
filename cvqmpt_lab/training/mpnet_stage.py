"""MPNet: learn to propose the next waypoint q_(t+1) from q_t, the goal and the encoded cloud z.

The loss is the mean over all steps, both ways, and joints of |g(q_t, q_goal, z) - q_(t+1)|^2. All
examples of a batch count, unlike in the published code.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from cvqmpt_lab.training.batches import BaseTurn, SceneBatches, SceneBatchSettings, other_scenes
from cvqmpt_lab.training.dataset import PathDataset
from cvqmpt_lab.training.stage import Means, OptimizerSettings, Stage
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint
from cvqmpt_lab.vqmpt.config import MPNetConfig
from cvqmpt_lab.vqmpt.mpnet import MPNet


@dataclass(frozen=True, kw_only=True)
class MPNetSettings:
    """How MPNet is trained; clouds have as many points as its network takes."""

    epochs: int = 20
    batches: SceneBatchSettings = field(default_factory=lambda: SceneBatchSettings(spacing=0.5))
    optimizer: OptimizerSettings = field(default_factory=lambda: OptimizerSettings(rate=3e-4))


class MPNetStage(Stage):
    """Training of an `MPNet`."""

    selection = "validation_squared_error"

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
        self.dataset: PathDataset = dataset.thinned(settings.batches.spacing)
        self._settings = settings.batches
        self._turn = BaseTurn(self.dataset, settings.batches.turn_base)
        self._validation = SceneBatches.for_validation(self.dataset, settings.batches, seed)
        self.module = self.network = MPNet(config).to(device)

    def batches(self, epoch: int) -> SceneBatches:
        """Batches of an epoch."""
        return SceneBatches.of_epoch(self.dataset, self._settings, self._turn, self.seed, epoch)

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Mean of |g(q_t, q_goal, z) - q_(t+1)|^2 over joints, all steps and both directions."""
        return {"loss": self._squared_error(batch, batch["cloud"], stochastic=True)}

    def validate(self) -> dict[str, float | None]:
        """Loss on held-out scenes with their own cloud and with another scene's; no dropout."""
        means = Means()
        for index in range(len(self._validation)):
            batch = self.tensors(self._validation[index])
            clouds = {"": batch["cloud"]}
            others = other_scenes(batch["scene"].cpu().numpy())
            if others is not None:
                clouds["wrong_cloud_"] = batch["cloud"][others]
            for prefix, cloud in clouds.items():
                error = self._squared_error(batch, cloud, stochastic=False)
                means.add(f"{prefix}squared_error", float(error), 1)
        names = ("squared_error", "wrong_cloud_squared_error")
        return {name: means.values().get(name) for name in names}

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
