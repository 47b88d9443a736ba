"""The gate between Python and compiled code: kernels believe the shapes of their arrays, so those are checked here.

A kernel that Python calls is marked `entry`. Its annotations say what each array must look like, for example
``Annotated[np.ndarray, "m n"]`` (float64) or ``Annotated[np.ndarray, "int64 2 capacity"]``; a bundle of arrays
says so at its own fields. A letter stands for one number throughout a call (n joints), a word for one among the
arguments or the fields of one bundle. Numbers are annotated `float`, `int` or `bool`. Inside other kernels an entry is
the bare kernel: the gate costs some microseconds a call from Python, and nothing per state.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any, NamedTuple, get_type_hints

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.annotations import ArrayForm, array_of
from cvqmpt_lab.kernels.compiling import Kernel
from cvqmpt_lab.kernels.objects import function


class _Bundle(NamedTuple):
    """An argument or field that holds arrays of its own."""

    place: int
    name: str
    members: tuple["ArrayForm | _Bundle", ...]


def entry(kernel: Kernel) -> "Entry":
    """Check the arrays of a kernel whenever Python calls it; see the module."""
    return Entry(kernel)


class Entry:
    """A kernel behind its gate; arguments are given by position."""

    def __init__(self, kernel: Kernel) -> None:
        self.kernel = kernel
        functools.update_wrapper(self, kernel.py_func)
        self.name = kernel.py_func.__name__
        self.symbol = f"{kernel.py_func.__module__}.{self.name}"
        self.names = tuple(inspect.signature(kernel.py_func).parameters)

    @property
    def _numba_type_(self) -> Any:
        return self.kernel._numba_type_  # to compiled callers this is the kernel itself

    @functools.cached_property
    def _expected(self) -> tuple["ArrayForm | _Bundle", ...]:
        hints = get_type_hints(self.kernel.py_func, include_extras=True)
        return _expected({name: hints[name] for name in self.names}, list(self.names), deep=False)

    @functools.cached_property
    def _native(self) -> Callable[[tuple], Any]:
        return function(self)

    def __call__(self, *arguments: Any) -> Any:
        """Call the kernel, or raise InvalidInputError that names the array at fault."""
        if len(arguments) != len(self.names):
            raise TypeError(
                f"{self.name} takes {', '.join(self.names)}; {len(arguments)} arguments were given"
            )
        _check(arguments, self._expected, {}, self.name)
        return self._native(arguments)

    def unchecked(self, *arguments: Any) -> Any:
        """The same for a caller that has checked the shapes: bundles cost the gate some ten microseconds a call."""
        return self._native(arguments)


def check_bundle(bundle: NamedTuple) -> None:
    """InvalidInputError unless all arrays of a bundle, and of bundles in it, fit its annotations and each other."""
    _check(bundle, _members(type(bundle), True), {}, type(bundle).__name__)


@functools.cache
def _members(bundle: Any, deep: bool) -> tuple[ArrayForm | _Bundle, ...]:
    """What the fields of a bundle must look like; deep: those of bundles in it as well."""
    return _expected(get_type_hints(bundle, include_extras=True), list(bundle._fields), deep, nested=True)


def _expected(
    hints: dict[str, Any], names: list[str], deep: bool, nested: bool = False
) -> tuple[ArrayForm | _Bundle, ...]:
    found: list[ArrayForm | _Bundle] = []
    for name, hint in hints.items():
        place = names.index(name)
        if hasattr(hint, "__metadata__"):
            found.append(array_of(hint, place, name))
        elif hasattr(hint, "_fields") and (deep or not nested):
            found.append(_Bundle(place, name, _members(hint, deep)))
    return tuple(found)


def _check(
    values: tuple, expected: tuple[ArrayForm | _Bundle, ...], sizes: dict[str, int], where: str
) -> None:
    """Compare values with what is expected of them; sizes: numbers found so far for names of dimensions."""
    for item in expected:
        value = values[item.place]
        if isinstance(item, _Bundle):
            own = {name: size for name, size in sizes.items() if len(name) == 1}
            _check(value, item.members, own, f"{where}.{item.name}")
            sizes.update((name, size) for name, size in own.items() if len(name) == 1)
            continue
        right = type(value) is np.ndarray and value.dtype == item.dtype and value.ndim == len(item.shape)
        if right and value.flags.c_contiguous:
            for size, name in zip(value.shape, item.shape, strict=True):
                if size != (name if isinstance(name, int) else sizes.setdefault(name, size)):
                    break
            else:
                continue
        raise InvalidInputError(_complaint(value, item, sizes, where))


def _complaint(value: Any, item: ArrayForm, sizes: dict[str, int], where: str) -> str:
    wanted = ", ".join(f"{name} = {sizes[name]}" if name in sizes else str(name) for name in item.shape)
    if not isinstance(value, np.ndarray):
        return f"{where}: {item.name} is a {type(value).__name__}; give an array ({wanted}) of {item.dtype}"
    order = "" if value.flags.c_contiguous else ", not contiguous (np.ascontiguousarray cures that)"
    return f"{where}: {item.name} has shape {value.shape} of {value.dtype}{order}; needed: ({wanted}) of {item.dtype}"
