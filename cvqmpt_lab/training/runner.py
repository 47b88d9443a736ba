"""From a dataset folder and a profile to a trained model: what `cvqmpt train` calls."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cvqmpt_lab.codec.plain import to_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import locked, make_folder
from cvqmpt_lab.training.dataset import PathDataset, open_dataset
from cvqmpt_lab.training.loop import Limits, Tick, TrainingEnd, train
from cvqmpt_lab.training.mpnet import MPNetStage
from cvqmpt_lab.training.profiles import PROFILES, Profile
from cvqmpt_lab.training.ranks import Ranks
from cvqmpt_lab.training.run_folder import RunFolder
from cvqmpt_lab.training.stage import Stage
from cvqmpt_lab.training.stage1 import Stage1
from cvqmpt_lab.training.stage2 import Stage2
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint, load_checkpoint
from cvqmpt_lab.vqmpt.weights import checkpoint_folder, recover_weights, weights_digest


@dataclass(frozen=True, kw_only=True)
class Request:
    """One training."""

    stage: str
    """Of `STAGES`."""
    profile: Profile
    data: Path
    """Folder of a dataset."""
    out: Path
    """Folder of the training."""
    dictionary: Path | None = None
    """Folder of a stage-1 training or checkpoint."""
    seed: int = 0
    epochs: int | None = None
    """In all, instead of the profile's."""
    minutes: float | None = None
    """Stop when they are over."""
    workers: int = 0
    """Processes that prepare batches."""
    device: str = "auto"
    """``cpu``, ``cuda``, or whichever is there."""
    verify: bool = True
    """Compare shards with their checksums."""
    metadata: Mapping[str, Any]
    """Kept with the model."""


def _stage1(request: Request, dataset: PathDataset, device: torch.device) -> Stage:
    profile = request.profile
    return Stage1(dataset, profile.model_for(dataset), profile.stage1, request.seed, device)


def _stage2(request: Request, dataset: PathDataset, device: torch.device) -> Stage:
    profile = request.profile
    if profile.stage2 is None:
        own = ", ".join(name for name, one in PROFILES.items() if one.stage2 is not None)
        raise InvalidInputError(
            f"profile {profile.name!r} has no stage2: its models have no sequence model; "
            f"profiles with one: {own}"
        )
    dictionary = load_dictionary(request.dictionary)
    return Stage2(dataset, dictionary, profile.model_for(dataset), profile.stage2, request.seed, device)


def _mpnet(request: Request, dataset: PathDataset, device: torch.device) -> Stage:
    profile = request.profile
    return MPNetStage(dataset, profile.mpnet_model_for(dataset), profile.mpnet, request.seed, device)


STAGES: dict[str, Callable[[Request, PathDataset, torch.device], Stage]] = {
    "stage1": _stage1,
    "stage2": _stage2,
    "mpnet": _mpnet,
}


def run_training(request: Request, report: Callable[[Tick], None] = lambda tick: None) -> TrainingEnd:
    """Begin or continue a training; the best model is in ``out/model``.

    Raises
    ------
    InvalidInputError, UnknownChoiceError
        Before anything is written when data, dictionary or folder cannot be used, or another training uses the
        folder; or when `torchrun` starts several processes for a stage whose steps share more than gradients.
    """
    if request.stage not in STAGES:
        raise UnknownChoiceError("stage", request.stage, STAGES)
    if request.dictionary is not None and request.stage != "stage2":
        raise InvalidInputError(f"{request.stage} takes no dictionary; leave it out")
    ranks, device = Ranks.joined(), _device(request.device)
    dataset = open_dataset(request.data, verify=request.verify)
    stage = STAGES[request.stage](request, dataset, device)
    if ranks.count > 1 and not stage.shares_gradients_alone:
        raise InvalidInputError(
            f"{request.stage} is trained by one process, not {ranks.count}; leave torchrun out"
        )
    plain = to_plain(request.profile, complete=True)
    epochs = request.epochs or plain[request.stage].pop("epochs")
    plain[request.stage].pop("epochs", None)
    settings: dict[str, Any] = {
        "stage": request.stage,
        "profile": {
            name: plain[name] for name in ("name", "link_features", _MODELS[request.stage], request.stage)
        },
        "data_sha256": dataset.sha256,
        "seed": request.seed,
    }
    if ranks.count > 1:
        settings["processes"] = ranks.count
    if request.dictionary is not None:
        settings["dictionary_sha256"] = weights_digest(
            checkpoint_folder(request.dictionary) or request.dictionary
        )
    chain = None if dataset.chain is None else to_plain(dataset.chain)
    metadata = {
        **settings,
        "kinematics": chain,
        "train_paths": len(dataset.split("train")),
        "validation_paths": len(dataset.split("validation")),
        **request.metadata,
    }
    limits = Limits(epochs=epochs, minutes=request.minutes, workers=request.workers, ranks=ranks)
    if not ranks.is_first:
        ranks.wait()  # until the first has made the folder
        return train(stage, RunFolder(request.out, settings), limits, metadata)
    make_folder(request.out)
    with locked(request.out):
        folder = RunFolder(request.out, settings)
        recover_weights(folder.model)
        ranks.wait()
        return train(stage, folder, limits, metadata, report)


_MODELS = {"stage1": "model", "stage2": "model", "mpnet": "mpnet_model"}


def load_dictionary(folder: Path | None) -> Checkpoint:
    """Read the checkpoint of stage 1 from its training's folder, or from the checkpoint itself.

    Raises
    ------
    InvalidInputError
        When there is none.
    """
    if folder is None:
        raise InvalidInputError("stage2 needs the dictionary that stage1 trained; name its folder")
    return load_checkpoint(checkpoint_folder(folder) or folder)


def _device(name: str) -> torch.device:
    if name not in ("auto", "cpu", "cuda"):
        raise UnknownChoiceError("device", name, ("auto", "cpu", "cuda"))
    if name == "cuda" and not torch.cuda.is_available():
        raise InvalidInputError("device cuda: torch finds no GPU here; use cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
