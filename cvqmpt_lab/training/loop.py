"""The loop that all trainings share: epochs of batches, resumable anywhere, repeatable by seed.

Whatever is random in a batch is drawn from its seed, epoch and number alone, so that a training that was
stopped and continued takes the same steps as one that was not.
"""

import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.training.run_folder import Progress, RunFolder

SAVE_EVERY_S = 300.0
Batch = dict[str, Tensor]


@dataclass(frozen=True, kw_only=True)
class OptimizerSettings:
    """Adam, its rate warmed up and lowered.

    Attributes
    ----------
    rate: at the peak.
    warmup: steps until there.
    schedule: after it: ``inverse-sqrt`` of steps (published), ``cosine`` to `final` of the peak at the last
        epoch, or ``constant``.
    clip: longest gradient; None to leave it.
    """

    kind: Literal["adam", "adagrad"] = "adam"
    rate: float
    warmup: int = 200
    schedule: Literal["inverse-sqrt", "cosine", "constant"] = "inverse-sqrt"
    final: float = 0.02
    betas: tuple[float, float] = (0.9, 0.98)
    epsilon: float = 1e-9
    weight_decay: float = 0.0
    clip: float | None = None

    def build(self, parameters: Iterator[nn.Parameter]) -> torch.optim.Optimizer:
        """The optimizer."""
        if self.kind == "adagrad":
            return torch.optim.Adagrad(parameters, lr=self.rate)
        return torch.optim.AdamW(
            parameters, lr=self.rate, betas=self.betas, eps=self.epsilon, weight_decay=self.weight_decay
        )

    def rate_at(self, step: int, total: int) -> float:
        """Rate of step 1, 2, ... of `total`."""
        warmup = max(self.warmup, 1)
        if step <= warmup or self.schedule == "constant":
            return self.rate * min(1.0, step / warmup)
        if self.schedule == "inverse-sqrt":
            return self.rate * math.sqrt(warmup / step)
        done = min(1.0, (step - warmup) / max(total - warmup, 1))
        return self.rate * (self.final + (1.0 - self.final) * 0.5 * (1.0 + math.cos(math.pi * done)))


class Stage(Protocol):
    """What is trained.

    Attributes
    ----------
    name: of the stage. optimizer: settings. selection: the column whose least value is the best model.
    panels: title to columns, of the picture of curves.
    """

    name: str
    optimizer: OptimizerSettings
    selection: str
    panels: ClassVar[Mapping[str, tuple[str, ...]]]

    @property
    def module(self) -> nn.Module:
        """What the optimizer changes and the state keeps."""

    def prepare(self) -> None:
        """Once, before the first step of a training."""

    def batches(self, epoch: int) -> Dataset:
        """Batches of an epoch: dictionaries of arrays, each a function of seed, epoch and its number."""

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Scalars of a batch; ``loss`` is minimised."""

    def after_step(self, progress: Progress, optimizer: torch.optim.Optimizer) -> None:
        """What else changes with a step."""

    def validate(self) -> dict[str, float | None]:
        """Values of the held-out paths, in evaluation mode."""

    def save(self, folder: Path, metadata: Mapping[str, Any]) -> None:
        """Write the checkpoint."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How long to train: epochs in all; minutes from now, None for no limit; processes preparing batches."""

    epochs: int
    minutes: float | None = None
    workers: int = 0


@dataclass(frozen=True)
class Tick:
    """After each batch: where the training stands, how many batches an epoch has, and seconds left."""

    stage: str
    epoch: int
    epochs: int
    batch: int
    batches: int
    loss: float
    seconds_left: float


@dataclass(frozen=True)
class Outcome:
    """How a call to `train` ended: finished all epochs, or out of minutes."""

    finished: bool
    progress: Progress


def batch_seed(seed: int, epoch: int, batch: int) -> np.random.SeedSequence:
    """The only source of randomness of a batch."""
    return np.random.SeedSequence((seed, epoch, batch))


def train(
    stage: Stage,
    folder: RunFolder,
    limits: Limits,
    seed: int,
    device: torch.device,
    metadata: Mapping[str, Any],
    report: Callable[[Tick], None] = lambda tick: None,
) -> Outcome:
    """Train until the epochs are done, the minutes are over, or Ctrl-C; the state is saved in every case.

    Raises
    ------
    InvalidInputError
        When the loss is no longer finite, or the disk refuses.
    KeyboardInterrupt
        After Ctrl-C (or SIGTERM), once saved.
    """
    optimizer = stage.optimizer.build(stage.module.parameters())
    progress = folder.load_state(stage.module, optimizer)
    if progress is None:
        progress = Progress()
        torch.manual_seed(seed)
        stage.prepare()
    began, already = time.perf_counter(), progress.seconds
    clock = _Clock(began, None if limits.minutes is None else began + 60.0 * limits.minutes)
    with _interruptible() as interrupted:
        while progress.epoch < limits.epochs:
            for losses, total in _run_epoch(stage, progress, optimizer, limits, seed, device):
                progress.seconds = already + time.perf_counter() - began
                left = clock.seconds_left(progress, limits.epochs, total)
                report(
                    Tick(
                        stage.name, progress.epoch, limits.epochs, progress.batch, total, losses["loss"], left
                    )
                )
                over = clock.is_over() and progress.batch < total
                if interrupted or over or clock.should_save():
                    folder.save_state(progress, stage.module, optimizer)
                if interrupted:
                    raise KeyboardInterrupt
                if over:
                    _save_unfinished(stage, folder, progress, metadata)
                    return Outcome(False, progress)
            _end_epoch(stage, folder, progress, optimizer, metadata, already, began)
            if interrupted:
                raise KeyboardInterrupt
            if clock.is_over() and progress.epoch < limits.epochs:
                return Outcome(False, progress)
    return Outcome(True, progress)


class _Clock:
    """Time spent, time to save, time left."""

    def __init__(self, began: float, end: float | None) -> None:
        self._began, self._end, self._saved, self._batches = began, end, began, 0

    def is_over(self) -> bool:
        return self._end is not None and time.perf_counter() >= self._end

    def should_save(self) -> bool:
        now = time.perf_counter()
        if now - self._saved < SAVE_EVERY_S:
            return False
        self._saved = now
        return True

    def seconds_left(self, progress: Progress, epochs: int, batches: int) -> float:
        self._batches += 1
        now = time.perf_counter()
        remaining = (epochs - progress.epoch) * batches - progress.batch
        left = (now - self._began) / self._batches * remaining
        return left if self._end is None else min(left, max(0.0, self._end - now))


def _run_epoch(
    stage: Stage,
    progress: Progress,
    optimizer: torch.optim.Optimizer,
    limits: Limits,
    seed: int,
    device: torch.device,
) -> Iterator[tuple[dict[str, float], int]]:
    """Steps of what is left of an epoch: their losses, and how many batches it has."""
    batches = stage.batches(progress.epoch)
    total = len(batches)  # type: ignore[arg-type]
    loader = DataLoader(
        batches,
        batch_size=None,
        sampler=range(progress.batch, total),
        num_workers=limits.workers,
        worker_init_fn=_ignore_interrupts,
    )
    stage.module.train()
    for batch in loader:
        state = batch_seed(seed, progress.epoch, progress.batch).spawn(1)[0].generate_state(1, np.uint64)
        torch.manual_seed(int(state[0]) >> 1)
        rate = stage.optimizer.rate_at(progress.step + 1, limits.epochs * total)
        losses = _step(stage, {name: part.to(device) for name, part in batch.items()}, optimizer, rate)
        if not math.isfinite(losses["loss"]):
            raise InvalidInputError(
                f"loss is {losses['loss']} in epoch {progress.epoch + 1}, batch {progress.batch + 1}; "
                "lower optimizer.rate and begin in another --out"
            )
        progress.step += 1
        progress.batch += 1
        stage.after_step(progress, optimizer)
        for name, value in losses.items():
            progress.sums[name] = progress.sums.get(name, 0.0) + value
        yield losses, total


def _step(stage: Stage, batch: Batch, optimizer: torch.optim.Optimizer, rate: float) -> dict[str, float]:
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.zero_grad(set_to_none=True)
    losses = stage.losses(batch)
    if not torch.isfinite(losses["loss"]):
        return {"loss": float(losses["loss"].detach())}
    losses["loss"].backward()
    if stage.optimizer.clip is not None:
        nn.utils.clip_grad_norm_(stage.module.parameters(), stage.optimizer.clip)
    optimizer.step()
    return {name: float(value.detach()) for name, value in losses.items()}


def _end_epoch(
    stage: Stage,
    folder: RunFolder,
    progress: Progress,
    optimizer: torch.optim.Optimizer,
    metadata: Mapping[str, Any],
    already: float,
    began: float,
) -> None:
    """Validate, keep the model if it is the best so far, and save."""
    stage.module.eval()
    with torch.no_grad():
        validation = stage.validate()
    count = max(progress.batch, 1)
    progress.seconds = already + time.perf_counter() - began
    row: dict[str, float | None] = {"epoch": progress.epoch + 1, "step": progress.step}
    row["seconds"] = round(progress.seconds, 1)
    row |= {f"train_{name}": value / count for name, value in progress.sums.items()}
    row |= {f"validation_{name}": value for name, value in validation.items()}
    progress.rows.append(row)
    progress.epoch, progress.batch, progress.sums = progress.epoch + 1, 0, {}
    selecting = row[stage.selection]
    if selecting is not None and (progress.best is None or selecting < progress.best):
        progress.best = selecting
        stage.save(folder.model, {**metadata, "losses": row, "torch": torch.__version__})
    folder.save_curves(progress.rows, stage.panels)
    folder.save_state(progress, stage.module, optimizer)


def _save_unfinished(
    stage: Stage, folder: RunFolder, progress: Progress, metadata: Mapping[str, Any]
) -> None:
    """Keep the model of an unfinished epoch if it is the best so far; the state and curves know nothing of it."""
    stage.module.eval()
    with torch.no_grad():
        validation = stage.validate()
    row = {f"validation_{name}": value for name, value in validation.items()}
    selecting = row[stage.selection]
    if selecting is not None and (progress.best is None or selecting < progress.best):
        losses = {"epoch": progress.epoch, "step": progress.step, **row}
        stage.save(folder.model, {**metadata, "losses": losses, "torch": torch.__version__})


def _ignore_interrupts(worker: int) -> None:
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """A list that a first Ctrl-C or SIGTERM makes true; a second one acts as usual."""
    received: list[int] = []
    earlier: dict[signal.Signals, Any] = {}

    def give_back() -> None:
        for number, handler in earlier.items():
            signal.signal(number, handler)

    def note(number: int, frame: object) -> None:
        received.append(number)
        give_back()

    try:
        for each in (signal.SIGINT, signal.SIGTERM):
            earlier[each] = signal.getsignal(each)
            signal.signal(each, note)
    except ValueError:  # not in the main thread: no signals here
        earlier.clear()
    try:
        yield received
    finally:
        give_back()
