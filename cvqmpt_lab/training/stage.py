"""What a training trains: a module with its batches, losses and validation."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from cvqmpt_lab.training.augmentation import BaseTurn
from cvqmpt_lab.training.dataset import PathDataset
from cvqmpt_lab.training.optimizer import OptimizerSettings
from cvqmpt_lab.training.run_folder import Progress
from cvqmpt_lab.training.scene_batches import SceneBatches, SceneBatchSettings, other_scenes
from cvqmpt_lab.vqmpt.checkpoint import Trained

Batch = dict[str, Tensor]


class Stage(ABC):
    """One of the trainings; `loop.train` runs it."""

    name: ClassVar[str]
    selection: ClassVar[str]
    """The column of the curves whose least value is the best model."""
    panels: ClassVar[Mapping[str, tuple[str, ...]]]
    """Title to columns, of the picture of curves."""

    shares_gradients_alone: ClassVar[bool] = False
    """Whether processes may train it together by averaging gradients: nothing else depends on past batches."""
    module: nn.Module
    """What the optimizer changes and the state keeps."""

    def __init__(
        self,
        dataset: PathDataset,
        spacing: float | None,
        turn_base: bool,
        optimizer: OptimizerSettings,
        seed: int,
        device: torch.device,
    ) -> None:
        """Prepare to train on a dataset, its waypoints `spacing` [rad] apart.

        Raises
        ------
        InvalidInputError
            When there is nothing to train on or validate with, or the robot cannot be turned about its base.
        """
        dataset.require_splits()
        self.dataset = dataset.thinned(spacing)
        self.turn = BaseTurn(self.dataset, turn_base)
        self.optimizer, self.seed, self.device = optimizer, seed, device
        torch.manual_seed(seed)

    def prepare(self) -> None:  # noqa: B027 (most stages have nothing to prepare)
        """Once, before the first step of a training."""

    @abstractmethod
    def batches(self, epoch: int) -> Dataset:
        """Batches of an epoch: dictionaries of arrays, each a function of seed, epoch and its number."""

    @abstractmethod
    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Scalars of a batch; ``loss`` is minimised."""

    def after_step(self, progress: Progress, optimizer: torch.optim.Optimizer) -> None:  # noqa: B027
        """What else changes with a step."""

    @abstractmethod
    def validate(self) -> dict[str, float | None]:
        """Values of the held-out paths, in evaluation mode."""

    @abstractmethod
    def checkpoint(self, metadata: Mapping[str, object]) -> Trained:
        """The model as it stands, to be saved."""


class SceneStageSettings(Protocol):
    """What every training on scenes is told."""

    @property
    def batches(self) -> SceneBatchSettings:
        """What a batch is made of."""

    @property
    def optimizer(self) -> OptimizerSettings:
        """How weights are changed."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A batch of held-out paths."""

    batch: Batch
    scene: np.ndarray
    """(s,) row of each scene."""
    clouds: dict[str, Tensor]
    """(s, points, 3) by the prefix of what is measured with them: each scene's own, and that of another scene
    if there is one."""


class SceneStage(Stage):
    """A training on paths with the clouds of their scenes."""

    shares_gradients_alone = True

    def __init__(
        self, dataset: PathDataset, settings: SceneStageSettings, seed: int, device: torch.device
    ) -> None:
        self._batches = settings.batches
        super().__init__(
            dataset, settings.batches.spacing, settings.batches.turn_base, settings.optimizer, seed, device
        )
        self._validation = SceneBatches.for_validation(self.dataset, settings.batches, seed)

    def batches(self, epoch: int) -> SceneBatches:
        """Batches of an epoch."""
        return SceneBatches.of_epoch(self.dataset, self._batches, self.turn, self.seed, epoch)

    def held_out(self) -> Iterator[HeldOut]:
        """Held-out scenes, with their own cloud and with that of another scene."""
        for index in range(len(self._validation)):
            arrays = self._validation[index]
            batch = {name: torch.from_numpy(array).to(self.device) for name, array in arrays.items()}
            clouds = {"": batch["cloud"]}
            others = other_scenes(arrays["scene"])
            if others is not None:
                clouds["wrong_cloud_"] = batch["cloud"][others]
            yield HeldOut(batch, arrays["scene"], clouds)
