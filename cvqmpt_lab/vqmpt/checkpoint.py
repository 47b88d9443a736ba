"""Trained models as torch modules: read, write, and import the authors' checkpoints.

Every tensor is checked. A model of the authors is two folders with three json files and two pickles
of tensors. A pickle that would run code is refused.
"""

import contextlib
import io
import pickle
import re
import tarfile
import warnings
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError, shown
from cvqmpt_lab.base.files import read_bytes, read_json_object
from cvqmpt_lab.vqmpt.config import ModelConfig, TransformerConfig
from cvqmpt_lab.vqmpt.dictionary import Dictionary
from cvqmpt_lab.vqmpt.published_network import PublishedSequenceModel
from cvqmpt_lab.vqmpt.scene_transformer import SceneTransformer
from cvqmpt_lab.vqmpt.weights import VQ_MPT, RobotSignature, StoredModel, read_model, write_model

Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained model as torch modules, with its configuration and robot."""

    config: Any  # an instance of a configuration class of `weights.ARCHITECTURES`
    robot: RobotSignature
    modules: Mapping[str, Any]  # torch modules by the name of their weights file
    metadata: Mapping[str, Any] = field(default_factory=dict)  # json values: how it was trained


def stored(checkpoint: Checkpoint) -> StoredModel:
    """Copy a checkpoint's present weights to plain arrays."""
    parts = {
        name: {
            key: tensor.detach().cpu().numpy().copy() for key, tensor in module.state_dict().items()
        }
        for name, module in checkpoint.modules.items()
    }
    return StoredModel(checkpoint.config, checkpoint.robot, parts, checkpoint.metadata)


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint to a folder; errors as in `write_model`."""
    write_model(folder, stored(checkpoint))


def load_checkpoint(folder: Path, robot: RobotSignature | None = None) -> Checkpoint:
    """Read a VQ-MPT checkpoint; errors as in `read_model` and `as_modules`."""
    return as_modules(read_model(folder, robot, VQ_MPT))


def as_modules(model: StoredModel) -> Checkpoint:
    """Return VQ-MPT's weights as torch modules on the CPU, in evaluation mode.

    Raises:
        InvalidInputError: tensors do not fit the sizes of the configuration.
    """
    builders: dict[str, Callable[[], nn.Module]] = {
        "dictionary": lambda: Dictionary(model.config),
        "sequence_model": lambda: PublishedSequenceModel(model.config),
        "transformer": lambda: SceneTransformer(model.config.transformer),
    }
    modules = {
        name: filled(builders[name], {key: torch.from_numpy(a) for key, a in arrays.items()}, name)
        for name, arrays in model.parts.items()
    }
    return Checkpoint(model.config, model.robot, modules, model.metadata)


def filled(
    build: Callable[[], Module],
    tensors: Mapping[str, Tensor],
    where: str,
    tolerance: float = 1e-4,
) -> Module:
    """Build a module, in evaluation mode, that has exactly these trained tensors.

    Names and shapes are compared before memory is allocated: a wrong file may ask for huge sizes.

    Args:
        build: builds the module.
        tensors: tensors of the module's state by name.
        where: file or part, at the beginning of an error message.
        tolerance: largest error of constant buffers, and of the unit length of codes.

    Raises:
        InvalidInputError: a tensor is missing or unknown, has another shape or dtype, is not
            finite, or is impossible after training: a negative variance, a code that is not of
            unit length, a constant of another model.
    """
    # a "meta" module has shapes but no data
    with torch.device("meta"):
        _require_fit(build(), tensors, where)
    module = build().eval()
    faults = []
    expected = module.state_dict()
    for name, tensor in tensors.items():
        if not tensor.to(expected[name].dtype).isfinite().all():
            faults.append(f"{name} has NaN or infinite values")
        last = name.rsplit(".", 1)[-1]
        constant = last in ("pos_table", "l_index")  # buffers that follow from the sizes
        if constant and (tensor - expected[name]).abs().max() > tolerance:
            faults.append(f"{name} is not the constant for the sizes of this model")
        if last == "running_var" and (tensor < 0.0).any():
            faults.append(f"{name} has negative variances")
        codes = f".{name}".endswith(".embedding.weight")  # planning needs codes of unit length
        if codes and ((tensor.norm(dim=1) - 1.0).abs() > tolerance).any():
            faults.append(f"{name} has codes that are not of unit length")
    _refuse(faults, where)
    module.load_state_dict(dict(tensors))
    return module


def _require_fit(module: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    expected = module.state_dict()
    faults = [f"{name} is missing" for name in expected if name not in tensors]
    for name, tensor in sorted(tensors.items()):
        if name not in expected:
            faults.append(f"{name} {tuple(tensor.shape)} is not part of the model")
        elif tensor.shape != expected[name].shape:
            faults.append(
                f"{name} is {tuple(tensor.shape)}, expected {tuple(expected[name].shape)}"
            )
        elif tensor.is_floating_point() != expected[name].is_floating_point():
            faults.append(f"{name} is {tensor.dtype}, expected {expected[name].dtype}")
        elif tensor.layout != torch.strided or tensor.is_meta or tensor.is_quantized:
            faults.append(f"{name} is sparse, quantized or without data")
    _refuse(faults, where)


def _refuse(faults: list[str], where: str) -> None:
    if faults:
        more = f" and {len(faults) - 5} more" if len(faults) > 5 else ""
        raise InvalidInputError(
            f"{where} does not fit its configuration: {'; '.join(faults[:5])}{more}"
        )


def import_published(dictionary_dir: Path, ar_dir: Path, robot: RobotSignature) -> Checkpoint:
    """Convert a published checkpoint; every tensor must fit, and unknown tensors are refused.

    Args:
        dictionary_dir: folder with ``model_params.json`` and ``best_model.pkl`` (stage 1).
        ar_dir: folder with ``cross_attn.json``, ``ar_params.json``, ``best_model.pkl`` (stage 2).
        robot: robot by whose joint limits the training data were scaled; not part of the files.

    Raises:
        InvalidInputError: a file, field or tensor does not fit; the message names it.
    """
    dictionary_dir, ar_dir = Path(dictionary_dir), Path(ar_dir)
    config = _config(dictionary_dir, ar_dir)
    path1, path2 = dictionary_dir / "best_model.pkl", ar_dir / "best_model.pkl"
    stage1, stage2 = read_tensors(path1), read_tensors(path2)
    names = {"encoder_state": "encoder", "quantizer_state": "quantizer"}
    tensors1 = _together(stage1, {**names, "decoder_state": "decoder"}, path1)
    dictionary = filled(lambda: Dictionary(config), tensors1, str(path1))
    names = {"context_state": "context", "ar_model_state": "autoregressive"}
    tensors2 = _together(stage2, names, path2)
    sequence_model = filled(lambda: PublishedSequenceModel(config), tensors2, str(path2))
    epochs = [stage.get("epoch") for stage in (stage1, stage2)]
    known = [epoch if isinstance(epoch, int) else None for epoch in epochs]
    metadata = {"source": "published checkpoint", "epochs": known}
    modules = {"dictionary": dictionary, "sequence_model": sequence_model}
    return Checkpoint(config, robot, modules, metadata)


def _config(dictionary_dir: Path, ar_dir: Path) -> ModelConfig:
    sizes = tuple(TransformerConfig.__dataclass_fields__)
    stage1 = _fields(dictionary_dir / "model_params.json", (*sizes, "n_position", "c_space_dim"))
    context = _fields(ar_dir / "cross_attn.json", (*sizes, "d_context"))
    sequence = _fields(ar_dir / "ar_params.json", (*sizes, "num_keys"))
    if context["d_context"] != stage1["c_space_dim"]:
        raise InvalidInputError(
            f"{ar_dir / 'cross_attn.json'}: d_context {context['d_context']} is not "
            f"c_space_dim {stage1['c_space_dim']} of the dictionary; give two folders of one model"
        )
    if sequence["num_keys"] < 3:
        raise InvalidInputError(
            f"{ar_dir / 'ar_params.json'}: num_keys {sequence['num_keys']} has no codes"
        )
    sizes1, sizes2, sizes3 = (
        {name: fields[name] for name in sizes} for fields in (stage1, context, sequence)
    )
    config = {
        "kind": "published",
        "joint_dim": stage1["c_space_dim"],
        "dictionary": {
            "transformer": sizes1,
            "n_position": stage1["n_position"],
            "n_codes": sequence["num_keys"] - 2,
            # a constant of the published scripts; the json files do not contain it
            "code_dim": 8,
        },
        "point_cloud": {"sa2": {"radius": 0.4, "widths": [256, stage1["d_model"]]}},
        "sequence": {"context": sizes2, "transformer": sizes3},
    }
    return from_plain(ModelConfig, config, f"{dictionary_dir} and {ar_dir}: ")


def _fields(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """Read exactly the named numbers from a json file."""
    data = read_json_object(path)
    for name in (*data, *names):
        if name not in names or name not in data:
            state = "unknown" if name not in names else "missing"
            raise InvalidInputError(f"{path}: {name} is {state}; fields: {', '.join(names)}")
        from_plain(float if name == "dropout" else int, data[name], f"{path}: {name}")
    return data


def _together(
    content: Mapping[str, Any], submodules: Mapping[str, str], where: Path
) -> dict[str, Tensor]:
    """Return all tensors of a stage by their names in our module.

    Args:
        content: states of the published modules by name.
        submodules: name of our submodule by the name of a published state.
        where: file, at the beginning of an error message.
    """
    tensors: dict[str, Tensor] = {}
    for name, part in submodules.items():
        state = content.get(name)
        if not isinstance(state, dict) or not all(
            isinstance(tensor, Tensor) for tensor in state.values()
        ):
            raise InvalidInputError(
                f"{where}: {name} is missing or does not consist of tensors; the file has "
                f"{', '.join(map(str, content))}"
            )
        tensors |= {f"{part}.{key}": tensor for key, tensor in state.items()}
    return tensors


def read_tensors(path: Path) -> dict[str, Any]:
    """Read a pickle that may hold tensors and plain values, but no code.

    Raises:
        InvalidInputError: the file is missing, empty, truncated, a web page, a tar archive, a
            compressed archive, or a pickle that would run code; the message says which of these.
    """
    data = read_bytes(path)
    if tarfile.is_tarfile(io.BytesIO(data)):  # torch would unpack it to a folder
        raise InvalidInputError(
            f"{path} is a tar archive, not a torch checkpoint; download it again"
        )
    packed = _compressed_record(data)
    if packed:  # its size when it is unpacked has no bound
        raise InvalidInputError(
            f"{path} has compressed records, which torch does not write: {packed}; save it again "
            "with torch.save"
        )
    # a saved learning rate may be a numpy scalar, by the module path of numpy 1 or of numpy 2
    scalar: Any = np.float64(0.0).__reduce__()[0]
    kinds = (np.dtypes.Float64DType, np.dtypes.Float32DType, np.dtypes.Int64DType)
    harmless = [scalar, (scalar, "numpy.core.multiarray.scalar"), np.dtype, *kinds]
    try:
        with torch.serialization.safe_globals(harmless), warnings.catch_warnings():
            # torch warns about kinds of pickles that are refused below
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True)
    # a damaged pickle can raise any exception
    except Exception as error:
        raise InvalidInputError(_refusal(path, data[:512], error)) from error
    if not isinstance(content, dict):
        raise InvalidInputError(
            f"{path} contains a {type(content).__name__}; expected a dictionary of states"
        )
    return content


def _compressed_record(data: bytes) -> str:
    """Return name and size of the first compressed record of a zip archive; "" without one."""
    with contextlib.suppress(zipfile.BadZipFile), zipfile.ZipFile(io.BytesIO(data)) as archive:
        for one in archive.infolist():
            if one.compress_type != zipfile.ZIP_STORED:
                return f"{shown(one.filename)} of {one.file_size} bytes"
    return ""


def _refusal(path: Path, beginning: bytes, error: Exception) -> str:
    """Return the error message for a file that is not a torch checkpoint."""
    if not beginning:
        return f"{path} is empty; download it again"
    if beginning.lstrip()[:1] == b"<":
        return f"{path} is a web page or xml, not a torch checkpoint; download the file itself"
    name = re.search(r"GLOBAL ([\w.]+)", str(error))
    if isinstance(error, pickle.UnpicklingError) and name:
        return (
            f"{path} is refused: it contains {name[1]}, which is not a tensor and could run code, "
            "or the file is truncated"
        )
    return (
        f"{path} is not a torch checkpoint, or is truncated ({type(error).__name__}); download it "
        "again"
    )
