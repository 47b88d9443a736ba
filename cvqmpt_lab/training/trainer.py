"""The training loop of all stages, resumable after any batch and repeatable by seed.

`cvqmpt train` calls it. Files of a training's folder are replaced whole or not at all::

    training.json   settings of the training, which must be equal to continue it
    state.pt        weights, optimizer and progress
    curves.csv      a line per epoch
    model/          checkpoint of the epoch with the best validation

Random numbers of a batch depend only on seed, epoch and number of the batch, so that a training
that was stopped and continued takes the same steps as one that was not.
"""

import io
import json
import logging
import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.errors import InvalidInputError, require_choice, whole_number
from cvqmpt_lab.base.files import (
    csv_table,
    differences,
    locked,
    make_folder,
    read_bytes,
    read_json_object,
    write_bytes,
    write_text,
)
from cvqmpt_lab.training.dataset import SplitName
from cvqmpt_lab.training.profiles import STAGE_MODELS, Profile
from cvqmpt_lab.training.stage import Stage, batch_seed
from cvqmpt_lab.vqmpt.checkpoint import save_checkpoint
from cvqmpt_lab.vqmpt.weights import (
    TRAINED_FOLDER,
    checkpoint_folder,
    recover_weights,
    weights_digest,
)

# called with the number of finished batches, the number of batches of all epochs, and a note
Report = Callable[[int, int, str], None]


@dataclass
class Progress:
    """Progress of a training."""

    epoch: int = 0  # number of finished epochs
    batch: int = 0  # number of finished batches in the unfinished epoch
    step: int = 0  # number of optimizer steps
    seconds: float = 0.0
    sums: dict[str, float] = field(default_factory=dict)  # sums of losses in the unfinished epoch
    rows: list[dict[str, float | None]] = field(default_factory=list)  # lines of the curves
    best: float | None = None  # smallest value of `Stage.selection`
    finished: bool = False  # whether all epochs are done; else the time limit stopped the training


class Effort(NamedTuple):
    """How long a training runs, and on what."""

    epochs: int | None = None  # total number of epochs; None for the profile's
    minutes: float | None = None  # time limit of this call; None for no limit
    workers: int = 0  # number of processes that prepare batches
    device: str = "auto"  # cpu, cuda, or auto for a GPU if there is one


WHOLE = Effort()


def run_training(
    stage: str,
    profile: Profile,
    data: Path,
    out: Path,
    *,
    dictionary: Path | None = None,
    seed: int = 0,
    effort: Effort = WHOLE,
    metadata: Mapping[str, Any],
    report: Report = lambda done, total, note: None,
) -> Progress:
    """Begin or continue a training; the best model is written to ``out/model``.

    Args:
        stage: name of the stage, a key of `profiles.STAGE_MODELS`.
        profile: models and settings.
        data: folder of the dataset.
        out: folder of the training.
        dictionary: folder of a training of stage 1 or of weights, for sequence models; None for
            the shipped dictionary.
        seed: seed of all random numbers.
        effort: how long, and on what.
        metadata: json values that are stored with the model.
        report: called after each batch.

    Raises:
        UnknownChoiceError: there is no such stage or device.
        InvalidInputError: before anything is written if data, dictionary or folder cannot be used;
            later if the loss is not finite or the disk is full.
        KeyboardInterrupt: after Ctrl-C or SIGTERM; the state is saved before.
    """
    seed = whole_number("seed", seed)
    made = profile.stage(stage, data, dictionary, seed, _device(effort.device))
    dataset = made.dataset
    plain = to_plain(profile, complete=True)
    epochs_of_profile = plain[stage].pop("epochs")
    used = {name: plain[name] for name in ("name", "link_features", STAGE_MODELS[stage], stage)}
    settings = {"stage": stage, "profile": used, "data_sha256": dataset.sha256, "seed": seed}
    if dictionary is not None:
        settings["dictionary_sha256"] = weights_digest(checkpoint_folder(dictionary) or dictionary)
    paths = {f"{name}_paths": len(dataset.split(name)) for name in get_args(SplitName)}
    if stage == "stage1" and paths["train_paths"] < 2000:
        logging.getLogger("cvqmpt").warning(
            "%d paths to train on, too few for a dictionary: give 2000 or more (the shipped one "
            "had 13 204); `cvqmpt data generate` makes them, and continues in its folder",
            paths["train_paths"],
        )
    stored = {**settings, "kinematics": to_plain(dataset.chain), **paths, **metadata}
    epochs = epochs_of_profile if effort.epochs is None else effort.epochs
    trainer = Trainer(made, out, epochs, effort.workers, stored)
    with locked(make_folder(out)):
        open_folder(out, settings)
        recover_weights(out / TRAINED_FOLDER)
        return trainer.train(effort.minutes, report)


def open_folder(folder: Path, settings: Mapping[str, Any]) -> None:
    """Write the settings to an empty folder, or compare them with the settings stored there.

    Raises:
        InvalidInputError: a setting differs, or the folder has other files.
    """
    path = folder / "training.json"
    if path.is_file():
        found = differences(read_json_object(path), json.loads(json.dumps(settings)))
        if found:
            raise InvalidInputError(
                f"{folder} holds another training ({min(found, key=len)}); use the same or choose "
                "another --out"
            )
    elif any(folder.iterdir()):
        raise InvalidInputError(
            f"{folder} is not empty and holds no training to continue; choose another --out"
        )
    else:
        write_text(path, json.dumps(settings, indent=2) + "\n")


class Trainer:
    """Trains a stage in a folder for some epochs."""

    def __init__(
        self, stage: Stage, folder: Path, epochs: int, workers: int, metadata: Mapping[str, Any]
    ) -> None:
        self.stage, self.folder, self.epochs, self.workers = stage, folder, epochs, workers
        self.metadata = metadata
        self.progress, self.optimizer = Progress(), stage.optimizer.build(stage)

    def train(
        self,
        minutes: float | None,
        report: Report = lambda done, total, note: None,
        save_every: float = 300.0,
    ) -> Progress:
        """Train until all epochs are done, the time limit is reached, or Ctrl-C.

        Args:
            minutes: time limit; None for no limit.
            report: called after each batch.
            save_every: time between saved states [s]; the last state is always saved.
        """
        if (self.folder / "state.pt").is_file():
            self._load()
        else:
            torch.manual_seed(self.stage.seed)
            self.stage.prepare()
        progress = self.progress
        seconds_before = progress.seconds
        began = saved = time.perf_counter()
        end = began + 60.0 * (math.inf if minutes is None else minutes)
        over = False
        with _interrupts() as received:
            while progress.epoch < self.epochs and not over:
                for total, loss in self._epoch():
                    now = time.perf_counter()
                    progress.seconds = seconds_before + now - began
                    done = progress.epoch * total + progress.batch
                    note = f"epoch {progress.epoch + 1}, loss {loss:.4f}"
                    report(done, self.epochs * total, note)
                    stop, over = bool(received), now >= end
                    over_within_epoch = over and progress.batch < total
                    if stop or over_within_epoch or now >= saved + save_every:
                        self._save()
                        saved = now
                    if stop:
                        raise KeyboardInterrupt
                    if over_within_epoch:
                        # replaced by the first whole epoch; a later epoch that is not whole is not
                        # kept, so that the model does not depend on where a training was stopped
                        if progress.best is None:
                            self._keep_if_best(self._validate(), progress.epoch)
                        break
                else:
                    self._end_epoch()
        progress.finished = progress.epoch >= self.epochs
        return progress

    def _epoch(self) -> Iterator[tuple[int, float]]:
        """Take the remaining steps of an epoch; yield the epoch's number of steps and the loss."""
        stage, progress = self.stage, self.progress
        batches = stage.batches(progress.epoch)
        total = len(batches)
        remaining = range(progress.batch, total)
        loader = DataLoader(
            batches,
            batch_size=None,
            sampler=remaining,
            num_workers=self.workers,
            worker_init_fn=_ignore_interrupt,
        )
        stage.train()
        for number, batch in zip(remaining, loader, strict=True):
            seed = batch_seed(stage.seed, progress.epoch, number).spawn(1)[0]
            torch.manual_seed(int(seed.generate_state(1, np.uint64)[0]) >> 1)
            rate = stage.optimizer.rate_at(progress.step + 1, self.epochs * total)
            losses = self._step({name: part.to(stage.device) for name, part in batch.items()}, rate)
            progress.step += 1
            progress.batch += 1
            stage.after_step(progress.epoch, progress.step, self.optimizer)
            for name, value in losses.items():
                progress.sums[name] = progress.sums.get(name, 0.0) + value
            yield total, losses["loss"]

    def _step(self, batch: dict[str, Tensor], rate: float) -> dict[str, float]:
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        losses = self.stage(batch)
        if not torch.isfinite(losses["loss"]):
            raise InvalidInputError(
                f"loss is {float(losses['loss'].detach())} in epoch {self.progress.epoch + 1}, "
                f"batch {self.progress.batch + 1}; lower optimizer.rate and begin in another --out"
            )
        losses["loss"].backward()
        if self.stage.optimizer.clip is not None:
            nn.utils.clip_grad_norm_(self.stage.parameters(), self.stage.optimizer.clip)
        self.optimizer.step()
        return {name: float(value.detach()) for name, value in losses.items()}

    def _end_epoch(self) -> None:
        """Validate, keep the model if it is the best so far, and save."""
        progress = self.progress
        row: dict[str, float | None] = {
            "epoch": progress.epoch + 1,
            "step": progress.step,
            "seconds": round(progress.seconds, 1),
            **{f"train_{name}": sum_ / progress.batch for name, sum_ in progress.sums.items()},
            **self._validate(),
        }
        progress.rows.append(row)
        progress.epoch, progress.batch, progress.sums = progress.epoch + 1, 0, {}
        progress.best = self._keep_if_best(row, progress.epoch)
        columns = list(dict.fromkeys(name for row in progress.rows for name in row))
        lines = [[row.get(name) for name in columns] for row in progress.rows]
        write_text(self.folder / "curves.csv", csv_table([columns, *lines]))
        self._save()

    def _validate(self) -> dict[str, float | None]:
        """Compute validation metrics, named as in curves.csv."""
        self.stage.eval()
        with torch.no_grad():
            return {f"validation_{name}": value for name, value in self.stage.validate().items()}

    def _keep_if_best(self, row: Mapping[str, float | None], epoch: int) -> float | None:
        """Save the model if it is the best so far; return the best value of `Stage.selection`."""
        value, best = row.get(self.stage.selection), self.progress.best
        if value is None or (best is not None and value >= best):
            return best
        losses = {**row, "epoch": epoch, "step": self.progress.step}
        metadata = {**self.metadata, "losses": losses, "torch": torch.__version__}
        save_checkpoint(self.folder / TRAINED_FOLDER, self.stage.checkpoint(metadata))
        return value

    def _save(self) -> None:
        """Write the state, with which the training can be continued."""
        state = {"module": self.stage.state_dict(), "optimizer": self.optimizer.state_dict()}
        content = io.BytesIO()
        torch.save({**state, "progress": vars(self.progress)}, content)
        write_bytes(self.folder / "state.pt", content.getvalue())

    def _load(self) -> None:
        path = self.folder / "state.pt"
        try:
            state = torch.load(io.BytesIO(read_bytes(path)), "cpu", weights_only=True)
            self.stage.load_state_dict(state["module"])
            self.optimizer.load_state_dict(state["optimizer"])
            self.progress = Progress(**state["progress"])
        # a damaged archive can raise any exception
        except Exception as error:
            raise InvalidInputError(f"{path} is damaged: {error}; choose another --out") from error


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Yield a list to which the first Ctrl-C or SIGTERM is added; a second one ends the program."""
    received: list[int] = []

    def note(number: int, frame: object) -> None:
        received.append(number)
        signal.signal(number, earlier[signal.Signals(number)])

    earlier = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)


def _ignore_interrupt(worker: int) -> None:
    # the trainer reacts to Ctrl-C; its worker processes must not end before it
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _device(name: str) -> torch.device:
    require_choice("device", name, ("auto", "cpu", "cuda"))
    if name == "cuda" and not torch.cuda.is_available():
        raise InvalidInputError("device cuda: torch finds no GPU here; use cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
