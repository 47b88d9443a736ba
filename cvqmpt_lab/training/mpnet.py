"""MPNet: learn to propose the next waypoint. All examples of a batch count, unlike in the published code."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from cvqmpt_lab.models.checkpoint import save_checkpoint
from cvqmpt_lab.models.mpnet.network import MPNet, MPNetCheckpoint, MPNetConfig
from cvqmpt_lab.training.augmentation import Augmentation
from cvqmpt_lab.training.dataset import PathDataset
from cvqmpt_lab.training.loop import Batch, OptimizerSettings
from cvqmpt_lab.training.run_folder import Progress
from cvqmpt_lab.training.scene_batches import SceneBatches, SceneBatchSettings, other_scenes


@dataclass(frozen=True, kw_only=True)
class MPNetSettings:
    """How MPNet is trained; clouds have as many points as its network takes."""

    epochs: int = 20
    batches: SceneBatchSettings = field(default_factory=lambda: SceneBatchSettings(spacing=0.5))
    optimizer: OptimizerSettings = field(default_factory=lambda: OptimizerSettings(rate=3e-4))


class MPNetStage:
    """Training of an `MPNet`; a `loop.Stage`."""

    name = "mpnet"
    selection = "validation_squared_error"
    panels: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "squared error of the next waypoint": (
            "train_loss",
            "validation_squared_error",
            "validation_wrong_cloud_squared_error",
        ),
    }

    def __init__(
        self,
        dataset: PathDataset,
        config: MPNetConfig,
        settings: MPNetSettings,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on a dataset; raises InvalidInputError where that is impossible."""
        dataset.require_splits()
        spacing = settings.batches.spacing
        self.dataset = dataset if spacing is None else dataset.thinned(spacing)
        self.settings, self.seed, self.optimizer = settings, seed, settings.optimizer
        self._augmentation = Augmentation(
            self.dataset, turn_base=settings.batches.turn_base, mirror=settings.batches.mirror
        )
        self._device = device
        torch.manual_seed(seed)
        self.network = MPNet(config).to(device)
        self.module: nn.Module = self.network
        self._validation = SceneBatches.for_validation(self.dataset, settings.batches, seed)

    def prepare(self) -> None:
        """Nothing."""

    def batches(self, epoch: int) -> SceneBatches:
        """Batches of an epoch."""
        return SceneBatches.of_epoch(
            self.dataset, self.settings.batches, self._augmentation, self.seed, epoch
        )

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Mean squared error over joints of all steps of all paths, both ways."""
        return {"loss": self._squared_error(batch, batch["cloud"], stochastic=True)}

    def after_step(self, progress: Progress, optimizer: torch.optim.Optimizer) -> None:
        """Nothing."""

    def validate(self) -> dict[str, float | None]:
        """Error on held-out scenes with their own cloud, and with the cloud of another scene; no dropout."""
        own, wrong = [], []
        for index in range(len(self._validation)):
            arrays = self._validation[index]
            batch = {name: torch.from_numpy(array).to(self._device) for name, array in arrays.items()}
            own.append(float(self._squared_error(batch, batch["cloud"], stochastic=False)))
            others = other_scenes(arrays["scene"])
            if others is not None:
                wrong.append(float(self._squared_error(batch, batch["cloud"][others], stochastic=False)))
        return {
            "squared_error": sum(own) / len(own),
            "wrong_cloud_squared_error": sum(wrong) / len(wrong) if wrong else None,
        }

    def save(self, folder: Path, metadata: Mapping[str, Any]) -> None:
        """Write the network as a checkpoint."""
        save_checkpoint(folder, MPNetCheckpoint(self.dataset.robot, self.network, dict(metadata)))

    def _squared_error(self, batch: Batch, cloud: Tensor, *, stochastic: bool) -> Tensor:
        states, counts = 2.0 * batch["u"] - 1.0, batch["counts"]
        codes = self.network.encode(cloud).repeat_interleave(len(states) // len(cloud), 0)
        step = torch.arange(states.shape[1] - 1, device=states.device)
        rows, place = ((step < counts[:, None] - 1) & batch["weight"][:, None]).nonzero(as_tuple=True)
        before, after = states[rows, place], states[rows, place + 1]
        start, goal = states[rows, 0], states[rows, counts[rows] - 1]
        proposed = self.network(
            torch.cat((before, after)),
            torch.cat((goal, start)),
            codes[rows].repeat(2, 1),
            stochastic=stochastic,
        )
        return (proposed - torch.cat((after, before))).square().mean()
