"""What annotations of entries say of arrays, see `entry`, and what is asked of an entry to compile it."""

from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, Protocol

import numpy as np

DTYPES = {name: np.dtype(name) for name in ("float64", "float32", "int64", "int32", "int8", "uint8", "bool")}


class Dispatched(Hashable, Protocol):
    """A kernel."""

    py_func: Callable
    """As it is written."""

    @property
    def dispatcher(self) -> Any:
        """What numba makes of it."""


class Compilable(Protocol):
    """An entry."""

    symbol: str
    """Under which its machine code is found."""
    names: tuple[str, ...]
    """Of its arguments."""

    @property
    def kernel(self) -> Dispatched:
        """What is compiled."""


class ArrayForm(NamedTuple):
    """What an array must look like."""

    place: int
    """Which argument or field it is."""
    name: str
    dtype: np.dtype
    shape: tuple[int | str, ...]
    """Numbers, or names that stand for one."""


def array_of(hint: Any, place: int = 0, name: str = "") -> ArrayForm:
    """What an array's annotation says."""
    words = hint.__metadata__[0].split()
    dtype = DTYPES[words.pop(0)] if words[0] in DTYPES else DTYPES["float64"]
    return ArrayForm(place, name, dtype, tuple(int(word) if word.isdigit() else word for word in words))
