"""Compiled functions: numba's `njit` with our options, a cache folder, and checks of arguments.

A `kernel` is called by other kernels only. An `entry` is a kernel that Python calls, too: its
machine code is kept on disk, and its annotations say what each array must look like, for example
``Annotated[np.ndarray, "m n"]`` (float64) or ``Annotated[np.ndarray, "int64 2 capacity"]``. A named
tuple of arrays has annotations at its own fields. A letter stands for one number throughout a call
(n joints), a word for one among the arguments or fields of one named tuple. Numbers are annotated
`float`, `int` or `bool`.

Kernels make no arrays: numba's reference counting would cost more than the arithmetic of the hot
path (residual and Jacobian of a region: 3.7 us with it, 0.7 us without). Division is IEEE's; a
product and a sum may become one instruction (a quarter of forward kinematics).
"""

import contextlib
import functools
import pickle
import re
import shutil
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, get_type_hints

import numpy as np
from llvmlite import binding as llvm
from llvmlite import ir
from numba import config, from_dtype, njit, types
from numba.core.caching import FunctionCache, UserProvidedCacheLocator
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from cvqmpt_lab.base.caches import (
    cache_folder,
    named_folder,
    sources_digest,
    trusted_cache,
    written_by_owner_only,
)
from cvqmpt_lab.base.errors import InvalidInputError

OPTIONS = {
    "error_model": "numpy",
    "fastmath": {"contract"},
    "no_cfunc_wrapper": True,
    "_nrt": False,
}
INLINE: dict[str | None, dict] = {
    None: {},
    "machine": {"forceinline": True},
    "source": {"inline": "always"},
}
NUMBERS = {float: types.float64, int: types.int64, bool: types.boolean}
PACKAGE = Path(__file__).parents[1]
FILES = [
    file for file in sorted(PACKAGE.rglob("*.py")) if b"cvqmpt_lab.base.jit" in file.read_bytes()
]
# digest of all files with kernels: numba does not notice when a function that another calls is new
SOURCES = sources_digest(*FILES)


@functools.cache
def folder() -> Path | None:
    """The folder for machine code of these sources, or None."""
    place = trusted_cache(named_folder("NUMBA_CACHE_DIR", cache_folder()) / SOURCES)
    if place is not None:
        with contextlib.suppress(OSError):
            place.touch()
        forget_unused(place.parent)
    return place


def forget_unused(place: Path, kept: int = 8) -> None:
    """Remove machine code of all but the `kept` versions of the sources that were used last."""
    with contextlib.suppress(OSError):  # another process removes it, too
        ours = [
            one
            for one in place.iterdir()
            if re.fullmatch("[0-9a-f]{16}", one.name)
            # a folder that holds anything else is not ours
            and all(file.suffix in (".nbi", ".nbc", "") for file in one.iterdir())
        ]
        for old in sorted(ours, key=lambda one: one.stat().st_mtime_ns)[:-kept]:
            shutil.rmtree(old)


def compiled_before(everything: bool = False) -> bool:
    """Whether machine code is on disk: some of it, or of every entry."""
    return (place := folder()) is not None and any(
        place.glob("complete" if everything else "*.nbc")
    )


def compile_all(first: int = 0, stride: int = 1) -> None:
    """Compile every entry, or every stride-th one."""
    for file in FILES:
        import_module(".".join((PACKAGE.name, *file.relative_to(PACKAGE).with_suffix("").parts)))
    for compiled in Entry.all[first::stride]:
        _ = compiled.unchecked
    if (place := folder()) is not None and stride == 1:
        with contextlib.suppress(OSError), written_by_owner_only():
            (place / "complete").touch()


class Locator(UserProvidedCacheLocator):
    """Where numba keeps machine code: files lie in our folder itself, wherever the sources are."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        """No folder of its own for each folder of sources."""
        return ""

    def ensure_cache_path(self) -> None:
        """Nothing: numba would not read a folder that it cannot write."""


class _Cache(FunctionCache):
    """Machine code of an entry on disk; unreadable: compiled again, unwritable: not kept."""

    def function(self, sig: tuple[types.Type, ...]) -> Callable | None:
        """The function for a signature, from machine code alone, or None where it is not on disk.

        Numba's own way reads, too, what compiling its callers needs: rules of types (imports of
        0.3 s) and the intermediate code (10 ms an entry).
        """
        context = cpu_target.target_context
        try:
            kept = self._cache_file.load(self._index_key(sig, context.codegen()))
        except (OSError, EOFError, pickle.UnpicklingError):
            return None
        if kept is None:
            return None
        (name, form, (machine_code, _)), description, environment, *_ = kept
        # numba asks the intermediate code, here of an empty function, which names are defined
        named = f'define void @"{description.llvm_cpython_wrapper_name}"() {{ ret void }}'
        code = (machine_code, llvm.parse_assembly(named).as_bitcode())
        library = context.codegen().unserialize_library((name, form, code))
        return context.get_executable(library, description, environment)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The machine code for a signature, or None."""
        try:
            return super().load_overload(sig, target_context)
        # files damaged when the machine went down
        except (OSError, EOFError, pickle.UnpicklingError):
            with contextlib.suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep machine code for a signature."""
        try:
            with written_by_owner_only():
                super().save_overload(sig, data)
        except OSError as error:
            # shown once: Python leaves out warnings that were given at the same line
            warnings.warn(
                f"machine code cannot be kept in {folder()} ({error.strerror}): every process "
                "compiles for up to half a minute; set NUMBA_CACHE_DIR to a writable folder",
                stacklevel=1,
            )


def kernel(function: Callable | None = None, *, inline: str | None = None) -> Any:
    """A compiled function that other kernels call.

    inline: "machine" merges its machine code into every caller: a named tuple of arrays is passed
        as a hundred scalars, too slow in the hot path. "source" copies its source into its callers
        and does not compile it alone.
    """
    # numba copies the source of its own functions alone
    made = Kernel if inline != "source" else _numba_function
    compiled = functools.partial(made, options=INLINE[inline] | {"no_cpython_wrapper": True})
    return compiled if function is None else compiled(function)


def entry(function: Callable | None = None, *, inline: str | None = None) -> Any:
    """A compiled function that Python and other kernels call; inline: see `kernel`."""
    compiled = functools.partial(Entry, options=INLINE[inline])
    return compiled if function is None else compiled(function)


def _numba_function(function: Callable, options: dict[str, Any]) -> Any:
    return njit(**OPTIONS, **options)(function)


class Kernel:
    """A compiled function, made numba's own when something that calls it is compiled."""

    def __init__(self, function: Callable, options: dict[str, Any]) -> None:
        self.py_func, self.name, self.options = function, function.__name__, options
        self.__doc__, self.__module__ = function.__doc__, function.__module__

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Numba's function."""
        return _numba_function(self.py_func, self.options)

    @property
    def _numba_type_(self) -> Any:
        return self.dispatcher._numba_type_  # to compiled callers this is numba's function itself


class Entry(Kernel):
    """A compiled function whose arrays are checked when Python calls it, by position."""

    all: ClassVar[list["Entry"]] = []

    def __init__(self, function: Callable, options: dict[str, Any]) -> None:
        super().__init__(function, options)
        Entry.all.append(self)

    @functools.cached_property
    def cache(self) -> _Cache | None:
        """Its machine code on disk, or None."""
        if folder() is None:
            return None
        before = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = str(folder()), f"{__name__}.Locator"
        made = _Cache(self.py_func)
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = before
        return made

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Numba's function, which looks on disk before it compiles."""
        made = super().dispatcher
        if self.cache is not None:
            made._cache = self.cache
        return made

    @functools.cached_property
    def unchecked(self) -> Callable:
        """Its machine code, for callers that made the arrays: a check costs some microseconds."""
        signature = tuple(_numba_type(form) for form in _forms(self.py_func))
        known = self.cache and self.cache.function(signature)
        return known or self.dispatcher.compile(signature)

    def __call__(self, *arguments: Any) -> Any:
        """Call the machine code, or raise InvalidInputError that names the array at fault."""
        _check(arguments, _forms(self.py_func), {}, self.name, 1)
        return self.unchecked(*arguments)


@intrinsic
def call_address(typing_context, address):
    """Call the C function ``bool f()`` at an address."""

    def generate(context, builder, signature, arguments):
        function = ir.FunctionType(ir.IntType(8), [])
        pointer = builder.inttoptr(arguments[0], function.as_pointer())
        return builder.icmp_unsigned("!=", builder.call(pointer, []), ir.IntType(8)(0))

    return types.boolean(types.int64), generate


class _Form(NamedTuple):
    """What an argument, or a field of a named tuple, must look like."""

    name: str
    hint: Any  # float, int, bool, a named tuple's class, or an annotated array
    dtype: np.dtype | None = None  # of an array
    shape: tuple[int | str, ...] = ()  # of an array: numbers, or names that stand for one


@functools.cache
def _forms(annotated: Any) -> tuple[_Form, ...]:
    """Forms of a function's arguments or of a named tuple's fields, in order."""
    dtypes = ("float64", "float32", "int64", "int32", "int8", "uint8", "bool")
    found = []
    for name, hint in get_type_hints(annotated, include_extras=True).items():
        if not hasattr(hint, "__metadata__"):
            found.append(_Form(name, hint))
            continue
        words = hint.__metadata__[0].split()
        dtype = np.dtype(words.pop(0) if words[0] in dtypes else "float64")
        shape = tuple(int(word) if word.isdigit() else word for word in words)
        found.append(_Form(name, hint, dtype, shape))
    return tuple(found)


def _numba_type(form: _Form) -> types.Type:
    """Numba's type of what has a form."""
    if form.dtype is not None:
        return types.Array(from_dtype(form.dtype), len(form.shape), "C")
    if form.hint in NUMBERS:
        return NUMBERS[form.hint]
    return types.BaseTuple.from_types(tuple(map(_numba_type, _forms(form.hint))), form.hint)


def check_arrays(arrays: NamedTuple) -> None:
    """InvalidInputError unless all arrays of a named tuple fit annotations and each other."""
    _check(arrays, _forms(type(arrays)), {}, type(arrays).__name__, 9)


def _check(
    values: tuple, forms: tuple[_Form, ...], letters: dict[str, int], where: str, depth: int
) -> None:
    """Compare values with their forms, named tuples down to a depth.

    letters: sizes known for letters, throughout a call. Words hold among these values alone.
    """
    words: dict[str, int] = {}
    for value, form in zip(values, forms, strict=True):
        if form.dtype is None:
            if depth > 0 and form.hint not in NUMBERS:
                _check(value, _forms(form.hint), letters, f"{where}.{form.name}", depth - 1)
            continue
        is_array = type(value) is np.ndarray
        if is_array and value.dtype == form.dtype and value.ndim == len(form.shape):
            fits = value.flags.c_contiguous
            for size, name in zip(value.shape, form.shape, strict=True):
                if isinstance(name, int):
                    fits = fits and size == name
                elif fits:
                    known = letters if len(name) == 1 else words
                    fits = size == known.setdefault(name, size)
            if fits:
                continue
        sizes = {**letters, **words}
        wanted = ", ".join(
            f"{name} = {sizes[name]}" if name in sizes else str(name) for name in form.shape
        )
        given = f"is a {type(value).__name__}"
        if isinstance(value, np.ndarray):
            given = f"has shape {value.shape} of {value.dtype}"
            if not value.flags.c_contiguous:
                given += ", not contiguous (np.ascontiguousarray cures that)"
        raise InvalidInputError(f"{where}: {form.name} {given}; needed: ({wanted}) of {form.dtype}")
