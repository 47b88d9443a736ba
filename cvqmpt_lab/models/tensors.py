"""Tensors from files, checked before they fill a module."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import torch
from torch import Tensor, nn

from cvqmpt_lab.errors import InvalidInputError

CONSTANTS = ("pos_table", "l_index")
"""Buffers that follow from the sizes: a file that has others was made for another model."""
TOLERANCE = 1e-4
"""Of those, and of the length of codes."""

Module = TypeVar("Module", bound=nn.Module)


def filled(build: Callable[[], Module], tensors: Mapping[str, Tensor], where: str) -> Module:
    """Make a module with exactly these trained tensors, in evaluation mode.

    The module is made only once names and shapes are known to fit, so that sizes which no file bears out
    cost neither time nor memory.

    Raises
    ------
    InvalidInputError
        As `load_tensors`, and for what no training can have left: negative variances, codes that are not of
        unit length, constants of another model.
    """
    with torch.device("meta"):
        _require_fit(build(), tensors, where)
    module = build().eval()
    constants = {name: part.clone() for name, part in module.named_buffers() if _last(name) in CONSTANTS}
    load_tensors(module, tensors, where)
    state = module.state_dict()
    faults = [
        f"{name} is not that of this model's sizes"
        for name, expected in constants.items()
        if (state[name] - expected).abs().max() > TOLERANCE
    ]
    for name, tensor in state.items():
        if _last(name) == "running_var" and (tensor < 0.0).any():
            faults.append(f"{name} has negative variances")
        if f".{name}".endswith(".embedding.weight") and ((tensor.norm(dim=1) - 1.0).abs() > TOLERANCE).any():
            faults.append(f"{name} has codes that are not of unit length")
    _refuse(faults, where)
    return module


def load_tensors(module: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    """Copy tensors into a module of exactly their names and shapes.

    Raises
    ------
    InvalidInputError
        Naming, after `where`, the tensors that are missing, left over, of another shape or kind, or not finite
        in the module's precision.
    """
    _require_fit(module, tensors, where)
    expected = module.state_dict()
    require_finite({name: tensor.to(expected[name].dtype) for name, tensor in tensors.items()}, where)
    module.load_state_dict(dict(tensors))


def require_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    """Raise InvalidInputError naming the tensors that are not finite."""
    _refuse([f"{n} has NaN or infinite values" for n, t in tensors.items() if not t.isfinite().all()], where)


def _require_fit(module: nn.Module, tensors: Mapping[str, Tensor], where: str) -> None:
    expected = module.state_dict()
    faults = [f"{name} is missing" for name in expected if name not in tensors]
    for name, tensor in sorted(tensors.items()):
        if name not in expected:
            faults.append(f"{name} {tuple(tensor.shape)} is left over")
        elif tensor.shape != expected[name].shape:
            faults.append(f"{name} is {tuple(tensor.shape)}, expected {tuple(expected[name].shape)}")
        elif tensor.is_floating_point() != expected[name].is_floating_point():
            faults.append(f"{name} is {tensor.dtype}, expected {expected[name].dtype}")
        elif tensor.layout != torch.strided or tensor.is_meta or tensor.is_quantized:
            faults.append(f"{name} is sparse, quantized or without data")
    _refuse(faults, where)


def _last(name: str) -> str:
    return name.rsplit(".", 1)[-1]


def _refuse(faults: list[str], where: str) -> None:
    if faults:
        more = f" and {len(faults) - 5} more" if len(faults) > 5 else ""
        raise InvalidInputError(f"{where} does not fit its configuration: {'; '.join(faults[:5])}{more}")
