"""Import of the authors' checkpoints: two folders with three json files and two pickles of tensors.

Pickles are read without running anything: one that wants to run code is refused.
"""

import pickle
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cvqmpt_lab.codec import from_plain
from cvqmpt_lab.errors import InvalidInputError, located
from cvqmpt_lab.files import read_bytes, read_json_object, require_regular_file
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint, filled
from cvqmpt_lab.vqmpt.config import (
    DictionaryConfig,
    ModelConfig,
    PointCloudConfig,
    SequenceConfig,
    SetAbstractionConfig,
    TransformerConfig,
)
from cvqmpt_lab.vqmpt.dictionary import Dictionary
from cvqmpt_lab.vqmpt.published_network import PublishedSequenceModel
from cvqmpt_lab.vqmpt.weights import RobotSignature

SIZES = ("n_layers", "n_heads", "d_k", "d_v", "d_model", "d_inner", "dropout")
STAGE1 = {"encoder_state": "encoder", "quantizer_state": "quantizer", "decoder_state": "decoder"}
STAGE2 = {"context_state": "context", "ar_model_state": "autoregressive"}
"""States of each stage's pickle, by the part of our module that they fill."""
_NUMPY_SCALAR: Any = np.float64(0.0).__reduce__()[0]
_HARMLESS: list[Any] = [  # a learning rate may have been saved as a numpy number, under either path
    _NUMPY_SCALAR,
    (_NUMPY_SCALAR, "numpy.core.multiarray.scalar"),
    np.dtype,
    np.dtypes.Float64DType,
    np.dtypes.Float32DType,
    np.dtypes.Int64DType,
]


class Imported(NamedTuple):
    """A published model in this project's terms, and what was converted."""

    checkpoint: Checkpoint
    states: dict[str, tuple[int, int]]  # by name: its tensors, and the numbers in them
    epochs: tuple[int | None, int | None]  # of both stages
    ignored: tuple[str, ...]  # entries beside the states: optimizer, epoch, ...


def import_published(dictionary_dir: Path, ar_dir: Path, robot: RobotSignature) -> Imported:
    """Convert published checkpoints; every tensor finds its place and none is left over.

    Args:
        dictionary_dir: folder of ``model_params.json`` and ``best_model.pkl`` (stage 1).
        ar_dir: folder of ``cross_attn.json``, ``ar_params.json`` and ``best_model.pkl`` (stage 2).
        robot: by whose joint limits the training data were scaled; the files do not say.

    InvalidInputError names the file, field or tensors that do not fit.
    """
    dictionary_dir, ar_dir = Path(dictionary_dir), Path(ar_dir)
    config = _config(dictionary_dir, ar_dir)
    path1, path2 = dictionary_dir / "best_model.pkl", ar_dir / "best_model.pkl"
    stage1, stage2 = read_tensors(path1), read_tensors(path2)
    dictionary = filled(lambda: Dictionary(config), _together(stage1, STAGE1, path1), str(path1))
    tensors = _together(stage2, STAGE2, path2)
    sequence_model = filled(lambda: PublishedSequenceModel(config), tensors, str(path2))
    both, used = {**stage1, **stage2}, (*STAGE1, *STAGE2)
    first, second = stage1.get("epoch"), stage2.get("epoch")
    epochs = first if isinstance(first, int) else None, second if isinstance(second, int) else None
    metadata = {"source": "published checkpoint", "epochs": [*epochs]}
    return Imported(
        Checkpoint(config, robot, dictionary, sequence_model, metadata),
        {name: (len(both[name]), sum(t.numel() for t in both[name].values())) for name in used},
        epochs,
        tuple(sorted({str(name) for name in both} - {*used})),
    )


def _config(dictionary_dir: Path, ar_dir: Path) -> ModelConfig:
    stage1 = _fields(dictionary_dir / "model_params.json", (*SIZES, "n_position", "c_space_dim"))
    context = _fields(ar_dir / "cross_attn.json", (*SIZES, "d_context"))
    sequence = _fields(ar_dir / "ar_params.json", (*SIZES, "num_keys"))
    if context["d_context"] != stage1["c_space_dim"]:
        raise InvalidInputError(
            f"{ar_dir / 'cross_attn.json'}: d_context {context['d_context']} is not the "
            f"dictionary's c_space_dim {stage1['c_space_dim']}; these folders are not of one model"
        )
    if sequence["num_keys"] < 3:
        raise InvalidInputError(
            f"{ar_dir / 'ar_params.json'}: num_keys {sequence['num_keys']} has no codes"
        )
    with located(f"{dictionary_dir} and {ar_dir}"):
        return ModelConfig(
            kind="published",
            joint_dim=stage1["c_space_dim"],
            dictionary=DictionaryConfig(
                transformer=_sizes(stage1),
                n_position=stage1["n_position"],
                n_codes=sequence["num_keys"] - 2,
                # a constant of the published scripts, in none of the json files
                code_dim=8,
            ),
            point_cloud=PointCloudConfig(
                sa2=SetAbstractionConfig(radius=0.4, widths=(256, stage1["d_model"])),
            ),
            sequence=SequenceConfig(context=_sizes(context), transformer=_sizes(sequence)),
        )


def _sizes(fields: Mapping[str, Any]) -> TransformerConfig:
    return TransformerConfig(**{name: fields[name] for name in SIZES})


def _fields(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """Read exactly the named numbers from a json file."""
    data = read_json_object(require_regular_file(path))
    for name in (*data, *names):
        if name not in names or name not in data:
            state = "unknown" if name not in names else "missing"
            raise InvalidInputError(f"{path}: {name} is {state}; fields: {', '.join(names)}")
        from_plain(float if name == "dropout" else int, data[name], f"{path}: {name}")
    return data


def _together(
    content: Mapping[str, Any], places: Mapping[str, str], where: Path
) -> dict[str, Tensor]:
    """All tensors of a stage by the names that our module has for them."""
    tensors: dict[str, Tensor] = {}
    for name, part in places.items():
        state = content.get(name)
        if not isinstance(state, dict) or not all(
            isinstance(tensor, Tensor) for tensor in state.values()
        ):
            raise InvalidInputError(
                f"{where}: {name} is missing or not made of tensors; the file has "
                f"{', '.join(map(str, content))}"
            )
        tensors |= {f"{part}.{key}": tensor for key, tensor in state.items()}
    return tensors


def read_tensors(path: Path) -> dict[str, Any]:
    """Read a pickle that may hold tensors and plain values, nothing that runs.

    Raises InvalidInputError, which says what the file is instead: missing, a web page, empty, cut,
    or a pickle that wants to run code.
    """
    data = read_bytes(require_regular_file(path))
    try:
        with torch.serialization.safe_globals(_HARMLESS), warnings.catch_warnings():
            # about other pickles than we read
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True)
    # what a damaged pickle raises depends on the byte
    except Exception as error:
        raise InvalidInputError(_refusal(path, data[:512], error)) from error
    if not isinstance(content, dict):
        raise InvalidInputError(
            f"{path} holds a {type(content).__name__}; expected a dictionary of states"
        )
    return content


def _refusal(path: Path, beginning: bytes, error: Exception) -> str:
    if not beginning:
        return f"{path} is empty; fetch it again"
    if beginning.lstrip()[:1] == b"<":
        return f"{path} is a web page or xml, no torch checkpoint; fetch the file itself"
    asks = re.search(r"GLOBAL ([\w.]+)", str(error))
    if isinstance(error, pickle.UnpicklingError) and asks:
        return (
            f"{path} is refused: it holds {asks[1]}, more than tensors, and would run code, or is "
            "cut short"
        )
    return f"{path} is no torch checkpoint, or cut short ({type(error).__name__}); fetch it again"
