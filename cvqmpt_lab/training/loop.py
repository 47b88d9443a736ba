"""The loop that all trainings share: epochs of batches, resumable anywhere, repeatable by seed.

Whatever is random in a batch is drawn from its seed, epoch and number alone, so that a training that was
stopped and continued takes the same steps as one that was not.
"""

import math
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.processes import end_with_parent
from cvqmpt_lab.training.interrupts import interruptible
from cvqmpt_lab.training.ranks import Ranks
from cvqmpt_lab.training.run_folder import Progress, RunFolder
from cvqmpt_lab.training.scene_batches import batch_seed
from cvqmpt_lab.training.stage import Batch, Stage
from cvqmpt_lab.vqmpt.checkpoint import save_checkpoint

SAVE_EVERY_S = 300.0


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How long to train, and with how much help."""

    epochs: int
    """In all."""
    minutes: float | None = None
    """From now; None for no limit."""
    workers: int = 0
    """Processes that prepare batches."""
    ranks: Ranks = field(default_factory=Ranks)
    """Processes that train together."""


@dataclass(frozen=True)
class Tick:
    """After each batch: where the training stands."""

    epoch: int
    done: int
    """Batches of all epochs."""
    total: int
    """Batches of all epochs."""
    loss: float


@dataclass(frozen=True)
class TrainingEnd:
    """How a call to `train` ended."""

    finished: bool
    """All epochs are done; otherwise it ran out of minutes."""
    progress: Progress


def train(
    stage: Stage,
    folder: RunFolder,
    limits: Limits,
    metadata: Mapping[str, Any],
    report: Callable[[Tick], None] = lambda tick: None,
) -> TrainingEnd:
    """Train until the epochs are done, the minutes are over, or Ctrl-C; the state is saved in every case.

    Raises
    ------
    InvalidInputError
        When the loss is no longer finite, or the disk refuses.
    KeyboardInterrupt
        After Ctrl-C (or SIGTERM), once saved.
    """
    training = _Training(stage, folder, limits, metadata)
    progress, agreed = training.progress, limits.ranks.mean
    with interruptible() as interrupted:
        while progress.epoch < limits.epochs:
            for tick in training.epoch():
                report(tick)
                stop, over = agreed(bool(interrupted), training.is_over() and not training.epoch_is_done)
                if stop or over or training.should_save():
                    training.save_state()
                if stop:
                    raise KeyboardInterrupt
                if over:
                    training.keep_if_best(training.validate(), progress.epoch)
                    return TrainingEnd(False, progress)
            training.end_epoch()
            stop, over = agreed(bool(interrupted), training.is_over())
            if stop:
                raise KeyboardInterrupt
            if over and progress.epoch < limits.epochs:
                return TrainingEnd(False, progress)
    return TrainingEnd(True, progress)


class _Training:
    """A training at work: where it stands, and the clock."""

    def __init__(self, stage: Stage, folder: RunFolder, limits: Limits, metadata: Mapping[str, Any]) -> None:
        self.stage, self.folder, self.limits, self.metadata = stage, folder, limits, metadata
        self.optimizer = stage.optimizer.build(stage.module.parameters())
        progress = folder.load_state(stage.module, self.optimizer)
        if progress is None:
            progress = Progress()
            torch.manual_seed(stage.seed)
            stage.prepare()
            limits.ranks.share_weights(stage.module)
        self.progress = progress
        self._began = self._saved = time.perf_counter()
        self._already = progress.seconds
        self.epoch_is_done = False
        self._end = math.inf if limits.minutes is None else self._began + 60.0 * limits.minutes

    def epoch(self) -> Iterator[Tick]:
        """Take the steps of what is left of an epoch."""
        stage, progress, ranks = self.stage, self.progress, self.limits.ranks
        batches = stage.batches(progress.epoch)
        total = len(batches) // ranks.count  # type: ignore[arg-type]
        if not total:
            raise InvalidInputError(
                f"an epoch has fewer batches than the {ranks.count} processes; start fewer"
            )
        mine = range(progress.batch * ranks.count + ranks.rank, total * ranks.count, ranks.count)
        loader = DataLoader(
            batches,
            batch_size=None,
            sampler=mine,
            num_workers=self.limits.workers,
            worker_init_fn=partial(_begin_worker, os.getpid()),
        )
        stage.module.train()
        for number, batch in zip(mine, loader, strict=True):
            seed = batch_seed(stage.seed, progress.epoch, number).spawn(1)[0]
            torch.manual_seed(int(seed.generate_state(1, np.uint64)[0]) >> 1)
            rate = stage.optimizer.rate_at(progress.step + 1, self.limits.epochs * total)
            losses = self._step({name: part.to(stage.device) for name, part in batch.items()}, rate)
            progress.step += 1
            progress.batch += 1
            stage.after_step(progress, self.optimizer)
            for name, value in losses.items():
                progress.sums[name] = progress.sums.get(name, 0.0) + value
            progress.seconds = self._already + time.perf_counter() - self._began
            self.epoch_is_done = progress.batch == total
            done = progress.epoch * total + progress.batch
            yield Tick(progress.epoch, done, self.limits.epochs * total, losses["loss"])

    def _step(self, batch: Batch, rate: float) -> dict[str, float]:
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        losses = self.stage.losses(batch)
        if not torch.isfinite(losses["loss"]):
            raise InvalidInputError(
                f"loss is {float(losses['loss'].detach())} in epoch {self.progress.epoch + 1}, "
                f"batch {self.progress.batch + 1}; lower optimizer.rate and begin in another --out"
            )
        losses["loss"].backward()
        self.limits.ranks.average_gradients(self.stage.module.parameters())
        if self.stage.optimizer.clip is not None:
            nn.utils.clip_grad_norm_(self.stage.module.parameters(), self.stage.optimizer.clip)
        self.optimizer.step()
        values = self.limits.ranks.mean(*(float(value.detach()) for value in losses.values()))
        return dict(zip(losses, values, strict=True))

    def is_over(self) -> bool:
        """Out of minutes."""
        return time.perf_counter() >= self._end

    def should_save(self) -> bool:
        """Not saved for long."""
        return time.perf_counter() - self._saved >= SAVE_EVERY_S

    def save_state(self) -> None:
        """Write everything needed to continue."""
        if self.limits.ranks.is_first:
            self.folder.save_state(self.progress, self.stage.module, self.optimizer)
        self._saved = time.perf_counter()

    def end_epoch(self) -> None:
        """Validate, keep the model if it is the best so far, and save."""
        progress, count = self.progress, max(self.progress.batch, 1)
        validation = self.validate()
        progress.seconds = self._already + time.perf_counter() - self._began
        row: dict[str, float | None] = {"epoch": progress.epoch + 1, "step": progress.step}
        row["seconds"] = round(progress.seconds, 1)
        row |= {f"train_{name}": value / count for name, value in progress.sums.items()} | validation
        progress.rows.append(row)
        progress.epoch, progress.batch, progress.sums = progress.epoch + 1, 0, {}
        progress.best = self.keep_if_best(row, progress.epoch)
        if self.limits.ranks.is_first:
            self.folder.save_curves(progress.rows, self.stage.panels)
        self.save_state()

    def validate(self) -> dict[str, float | None]:
        """Values of the held-out paths, named as in the curves; none but in the first of processes."""
        if not self.limits.ranks.is_first:
            return {}
        self.stage.module.eval()
        with torch.no_grad():
            return {f"validation_{name}": value for name, value in self.stage.validate().items()}

    def keep_if_best(self, row: Mapping[str, float | None], epoch: int) -> float | None:
        """Save the model if it is the best so far; the least selecting value so far."""
        value, best = row.get(self.stage.selection), self.progress.best
        if value is None or (best is not None and value >= best):
            return best
        losses = {**row, "epoch": epoch, "step": self.progress.step}
        metadata = {**self.metadata, "losses": losses, "torch": torch.__version__}
        save_checkpoint(self.folder.model, self.stage.checkpoint(metadata))
        return value


def _begin_worker(parent: int, number: int) -> None:
    end_with_parent(parent)
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
