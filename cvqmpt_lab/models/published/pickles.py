"""Pickles of tensors from strangers: read without running anything, and told apart from what is none."""

import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_bytes, require_regular_file

_NUMPY_SCALAR: Any = np.float64(0.0).__reduce__()[0]
_HARMLESS: list[Any] = [  # a learning rate may have been saved as a numpy number, under either path
    _NUMPY_SCALAR,
    (_NUMPY_SCALAR, "numpy.core.multiarray.scalar"),
    np.dtype,
    np.dtypes.Float64DType,
    np.dtypes.Float32DType,
    np.dtypes.Int64DType,
]


def read_tensors(path: Path) -> dict[str, Any]:
    """Read a pickle that may hold tensors and plain values, nothing that runs.

    Raises
    ------
    InvalidInputError
        Saying what the file is instead: missing, a web page, empty, cut, or a pickle that wants to run code.
    """
    data = read_bytes(require_regular_file(path))
    try:
        with torch.serialization.safe_globals(_HARMLESS), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about other pickles than we read
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what a damaged pickle raises depends on the byte
        raise InvalidInputError(_refusal(path, data[:512], error)) from error
    if not isinstance(content, dict):
        raise InvalidInputError(f"{path} holds a {type(content).__name__}; expected a dictionary of states")
    return content


def _refusal(path: Path, beginning: bytes, error: Exception) -> str:
    if not beginning:
        return f"{path} is empty; fetch it again"
    if beginning.lstrip()[:1] == b"<":
        return f"{path} is a web page or xml, no torch checkpoint; fetch the file itself"
    asks = re.search(r"GLOBAL ([\w.]+)", str(error))
    if isinstance(error, pickle.UnpicklingError) and asks:
        return (
            f"{path} is refused: it holds {asks[1]}, more than tensors, and would run code, or is cut short"
        )
    return f"{path} is no torch checkpoint, or cut short ({type(error).__name__}); fetch it again"
