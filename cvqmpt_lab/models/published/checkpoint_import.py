"""Conversion of the published checkpoint folders: three json files and two pickles of tensors."""

import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.checkpoint import Checkpoint
from cvqmpt_lab.models.config import (
    DictionaryConfig,
    ModelConfig,
    PointCloudConfig,
    SequenceConfig,
    SetAbstractionConfig,
    TransformerConfig,
)
from cvqmpt_lab.models.dictionary.dictionary import Dictionary
from cvqmpt_lab.models.published.sequence_model import PublishedSequenceModel
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.models.weights_folder import load_tensors, read_json_object

WEIGHTS_FILE = "best_model.pkl"
CODE_DIM = 8
"""Dimensions of a code: a constant of the published scripts, in none of the json files."""

_SIZES = ("n_layers", "n_heads", "d_k", "d_v", "d_model", "d_inner", "dropout")
_NUMPY_SCALAR: Any = np.float64(0.0).__reduce__()[0]
_HARMLESS: list[Any] = [  # a learning rate may have been saved as a numpy number, under either path
    _NUMPY_SCALAR,
    (_NUMPY_SCALAR, "numpy.core.multiarray.scalar"),
    np.dtype,
    np.dtypes.Float64DType,
    np.dtypes.Float32DType,
    np.dtypes.Int64DType,
]


@dataclass(frozen=True)
class ImportedState:
    """One state dictionary of the pickles, all of it used: its name, tensors and numbers."""

    name: str
    tensors: int
    parameters: int


@dataclass(frozen=True)
class ImportReport:
    """What was converted, and which entries beside the tensors were not (optimizer, epoch, ...)."""

    states: tuple[ImportedState, ...]
    dictionary_epoch: int | None
    sequence_epoch: int | None
    ignored: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ImportedModel:
    """A published model in this project's terms."""

    checkpoint: Checkpoint
    report: ImportReport


def import_published(dictionary_dir: Path, ar_dir: Path, robot: RobotSignature) -> ImportedModel:
    """Convert published checkpoints; every tensor finds its place and none is left over.

    Parameters
    ----------
    dictionary_dir
        Folder of ``model_params.json`` and ``best_model.pkl`` (stage 1).
    ar_dir
        Folder of ``cross_attn.json``, ``ar_params.json`` and ``best_model.pkl`` (stage 2).
    robot
        Whose joint limits the training data were scaled by; the files do not say.

    Raises
    ------
    InvalidInputError
        Naming the file that is missing, not json or not a pickle of tensors (a pickle that wants to run
        code is refused, never executed), the field that is unknown or missing, or the tensors that are
        missing, left over or of another shape.
    """
    dictionary_dir, ar_dir = Path(dictionary_dir), Path(ar_dir)
    config = _config(dictionary_dir, ar_dir)
    dictionary, sequence_model = Dictionary(config), PublishedSequenceModel(config)
    stage1 = _read_pickle(dictionary_dir / WEIGHTS_FILE)
    stage2 = _read_pickle(ar_dir / WEIGHTS_FILE)
    places = (
        (stage1, dictionary_dir, "encoder_state", dictionary.encoder),
        (stage1, dictionary_dir, "quantizer_state", dictionary.quantizer),
        (stage1, dictionary_dir, "decoder_state", dictionary.decoder),
        (stage2, ar_dir, "context_state", sequence_model.context),
        (stage2, ar_dir, "ar_model_state", sequence_model.autoregressive),
    )
    states = []
    for content, folder, name, module in places:
        where = f"{folder / WEIGHTS_FILE}, {name}"
        load_tensors(module, _state(content, name, where), where)
        parameters = sum(parameter.numel() for parameter in module.parameters())
        states.append(ImportedState(name, len(module.state_dict()), parameters))
    used = {name for _, _, name, _ in places}
    report = ImportReport(
        tuple(states),
        _epoch(stage1),
        _epoch(stage2),
        tuple(sorted({str(name) for name in (*stage1, *stage2)} - used)),
    )
    metadata = {"source": "published checkpoint", "epochs": [report.dictionary_epoch, report.sequence_epoch]}
    checkpoint = Checkpoint(config, robot, dictionary.eval(), sequence_model.eval(), metadata)
    return ImportedModel(checkpoint, report)


def _config(dictionary_dir: Path, ar_dir: Path) -> ModelConfig:
    stage1 = _fields(dictionary_dir / "model_params.json", (*_SIZES, "n_position", "c_space_dim"))
    context = _fields(ar_dir / "cross_attn.json", (*_SIZES, "d_context"))
    sequence = _fields(ar_dir / "ar_params.json", (*_SIZES, "num_keys"))
    if context["d_context"] != stage1["c_space_dim"]:
        raise InvalidInputError(
            f"{ar_dir / 'cross_attn.json'}: d_context {context['d_context']} is not the dictionary's "
            f"c_space_dim {stage1['c_space_dim']}; these folders are not of one model"
        )
    if sequence["num_keys"] < 3:
        raise InvalidInputError(f"{ar_dir / 'ar_params.json'}: num_keys {sequence['num_keys']} has no codes")
    width = stage1["d_model"]
    return ModelConfig(
        kind="published",
        joint_dim=stage1["c_space_dim"],
        dictionary=DictionaryConfig(
            transformer=_sizes(stage1),
            n_position=stage1["n_position"],
            n_codes=sequence["num_keys"] - 2,
            code_dim=CODE_DIM,
        ),
        point_cloud=PointCloudConfig(
            sa2=SetAbstractionConfig(ratio=0.75, radius=0.4, widths=(256, width)),
        ),
        sequence=SequenceConfig(context=_sizes(context), transformer=_sizes(sequence)),
    )


def _sizes(fields: Mapping[str, Any]) -> TransformerConfig:
    return TransformerConfig(**{name: fields[name] for name in _SIZES})


def _fields(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """Read exactly the named numbers from a json file."""
    data = read_json_object(path)
    for name in (*data, *names):
        if name not in names or name not in data:
            state = "unknown" if name not in names else "missing"
            raise InvalidInputError(f"{path}: {name} is {state}; fields: {', '.join(names)}")
        kind = (int, float) if name == "dropout" else (int,)
        if not isinstance(data[name], kind) or isinstance(data[name], bool) or data[name] < 0:
            raise InvalidInputError(f"{path}: {name} is {data[name]!r}; it must be a number, not negative")
    return data


def _read_pickle(path: Path) -> dict[str, Any]:
    """Read a pickle that may hold tensors and plain values, nothing that runs."""
    try:
        with torch.serialization.safe_globals(_HARMLESS):
            content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise InvalidInputError(f"cannot read {path}: {error.strerror}") from error
    except pickle.UnpicklingError as error:
        reason = str(error).split("WeightsUnpickler error: ")[-1].split(". ")[0].splitlines()[0]
        raise InvalidInputError(
            f"{path} is refused: it holds more than tensors and would run code ({reason})"
        ) from error
    except (RuntimeError, EOFError, ValueError, KeyError) as error:
        raise InvalidInputError(f"{path} is not a torch checkpoint: {str(error).splitlines()[0]}") from error
    if not isinstance(content, dict):
        raise InvalidInputError(f"{path} holds a {type(content).__name__}; expected a dictionary of states")
    return content


def _state(content: Mapping[str, Any], name: str, where: str) -> dict[str, Tensor]:
    state = content.get(name)
    if not isinstance(state, dict) or not all(isinstance(tensor, Tensor) for tensor in state.values()):
        raise InvalidInputError(
            f"{where} is missing or not made of tensors; the file has {', '.join(map(str, content))}"
        )
    return state


def _epoch(content: Mapping[str, Any]) -> int | None:
    epoch = content.get("epoch")
    return epoch if isinstance(epoch, int) else None
