"""Compiled functions: numba's `njit` with fixed options, a cache on disk, checks of arguments.

A `kernel` is called by other kernels only. An `entry` is a kernel that Python calls, too: its
machine code is kept on disk, and its annotations give type and shape of each array, for example
``Annotated[np.ndarray, "m n"]`` (float64) or ``Annotated[np.ndarray, "int64 2 capacity"]``. A named
tuple of arrays has annotations at its fields. A size that is a letter (n joints) is the same in the
whole call; a size that is a word is the same in the arguments, or in one named tuple. Numbers have
the annotations `float`, `int` or `bool`.

Kernels make no arrays: numba's reference counting would take longer than the arithmetic of inner
loops (residual and Jacobian of a region: 3.7 us with it, 0.7 us without). Division by 0 gives inf
or nan; a product and a sum may become one instruction (saves a quarter of forward kinematics).
"""

import contextlib
import functools
import hashlib
import io
import logging
import os
import pickle
import re
import shutil
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, NewType, get_type_hints

import numpy as np
from llvmlite import binding as llvm
from llvmlite import ir
from numba import config, from_dtype, njit, types
from numba.core import cgutils
from numba.core.caching import FunctionCache, IndexDataCacheFile, UserProvidedCacheLocator
from numba.core.errors import TypingError
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

_log = logging.getLogger("cvqmpt")
# numba's options for the values of `inline`, see `kernel`
INLINE_OPTIONS: dict[str | None, dict] = {
    None: {},
    "machine": {"forceinline": True},
    "source": {"inline": "always"},
    "never": {"no_cfunc_wrapper": False},
}
Pointer = NewType("Pointer", np.ndarray)  # to numbers, of an entry that is called by its `address`
SCALAR_TYPES: dict[Any, types.Type] = {
    float: types.float64,
    int: types.int64,
    bool: types.boolean,
    Pointer: types.CPointer(types.float64),
}
PACKAGE = Path(__file__).parents[1]
# links in a checkout, folders in a wheel: without them, both have the same digest
LINKED = {"cli", "experiments", "paper_tables"}
KERNEL_FILES = [
    file
    for file in sorted(PACKAGE.rglob("*.py"))
    if file.relative_to(PACKAGE).parts[0] not in LINKED
    and b"cvqmpt_lab.base.jit" in file.read_bytes()
]
# Digest of all files with kernels (numba does not notice a change of a function that is called) and
# of the processor that they are compiled for: machine code for another one is never loaded.
KERNELS_DIGEST = hashlib.sha256(
    repr(
        (sources_digest(*KERNEL_FILES), cpu_target.target_context.codegen().magic_tuple())
    ).encode()
).hexdigest()[:16]


@functools.cache
def folder() -> Path | None:
    """Return the folder for machine code of the present sources and processor, or None."""
    place = trusted_cache(named_folder("NUMBA_CACHE_DIR", cache_folder()) / KERNELS_DIGEST)
    if place is not None:
        with contextlib.suppress(OSError):
            place.touch()
        forget_unused(place.parent)
    return place


def forget_unused(place: Path, kept: int = 8) -> None:
    """Remove the machine code of old sources; the `kept` versions that were used last stay."""
    with contextlib.suppress(OSError):  # another process removes it, too
        versions = [
            version
            for version in place.iterdir()
            if re.fullmatch("[0-9a-f]{16}", version.name)
            # a folder with other files is not removed
            and all(file.suffix in (".nbi", ".nbc", "") for file in version.iterdir())
        ]
        for old in sorted(versions, key=lambda version: version.stat().st_mtime_ns)[:-kept]:
            shutil.rmtree(old)


def compiled_before() -> bool:
    """Return whether machine code of every entry is on disk."""
    place = folder()
    return place is not None and (place / "complete").exists()


def entries() -> list["Entry"]:
    """Return every entry of the package, always in the same order; its modules are imported."""
    modules = [
        ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts) for file in KERNEL_FILES
    ]
    for module in modules:
        import_module(module)
    found = (one for one in Entry.all if one.__module__ in modules)
    return sorted(found, key=lambda one: (one.__module__, one.name))


def compile_entry(number: int) -> None:
    """Compile the entry of a number in `entries`, or load its machine code."""
    _ = entries()[number].unchecked


def compile_all(progress: Callable[[int, int], object] = lambda done, total: None) -> None:
    """Compile every entry that is not on disk, in this process.

    progress: called with the number of entries that are ready, and that of all.
    """
    found = entries()
    for done, one in enumerate(found, 1):
        _ = one.unchecked
        progress(done, len(found))
    place = folder()
    if place is not None:
        with contextlib.suppress(OSError), written_by_owner_only():
            (place / "complete").touch()


def cores() -> int:
    """Return the number of cores that this process may use."""
    able = hasattr(os, "sched_getaffinity")  # not on macOS
    return len(os.sched_getaffinity(0)) if able else os.cpu_count() or 1


@functools.cache
def compile_before_clocks() -> None:
    """Compile every entry that is not ready: no clock may run while one is compiled."""
    if not compiled_before() and not all(one.ready for one in entries()):
        _log.warning("compiling kernels, two minutes, once per machine and version ...")
        compile_all()


def compile_in_processes(progress: Callable[[int, int], object]) -> None:
    """Compile every entry, in as many new processes as there are cores, and load them here.

    Nothing is done if all of them are on disk.

    progress: called with the number of entries that are compiled, and that of all.
    """
    from concurrent.futures import ProcessPoolExecutor, as_completed  # needed once a machine
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context

    if compiled_before():
        return
    count = cores()
    if count == 1 or folder() is None:  # without a folder, no process can use another's work
        compile_all(progress)
        return
    total = len(entries())
    progress(0, total)
    # what a killed process leaves is compiled here
    with (
        contextlib.suppress(BrokenProcessPool),
        ProcessPoolExecutor(min(count, total), get_context("spawn")) as workers,
    ):
        compiled = [workers.submit(compile_entry, number) for number in range(total)]
        for done, one in enumerate(as_completed(compiled), 1):
            one.result()
            progress(done, total)
    compile_all()


class Locator(UserProvidedCacheLocator):
    """Place of numba's files: directly in the cache folder, for sources in any folder."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        """Return "": all folders of sources share one cache folder."""
        return ""

    def ensure_cache_path(self) -> None:
        """Do nothing: numba's check would refuse a folder that can be read but not written."""


class _CheckedFiles(IndexDataCacheFile):
    """Numba's files of an entry, an index and machine code; each begins with its own sha256.

    A changed bit would end in a crash of the process. A changed file is removed, and the entry is
    compiled again. The digests of all 10 MB take 18 ms.
    """

    def _load_index(self) -> dict[Any, str]:
        try:
            stream = io.BytesIO(self._checked(self._index_path))
        except FileNotFoundError:
            return {}
        # data of another version may not be readable
        if pickle.load(stream) != self._version:
            return {}
        stamp, names = pickle.load(stream)
        return names if stamp == self._source_stamp else {}

    def _save_index(self, overloads: dict[Any, str]) -> None:
        content = self._dump((self._source_stamp, overloads))
        self._write(self._index_path, pickle.dumps(self._version) + content)

    def _load_data(self, name: str) -> Any:
        return pickle.loads(self._checked(self._data_path(name)))

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._data_path(name), self._dump(data))

    def _write(self, path: str, content: bytes) -> None:
        with self._open_for_write(path) as file:
            file.write(hashlib.sha256(content).digest() + content)

    def _checked(self, path: str) -> bytes:
        """Return the content of a file; FileNotFoundError if its digest is another."""
        data = Path(path).read_bytes()
        size = hashlib.sha256().digest_size
        if hashlib.sha256(memoryview(data)[size:]).digest() == data[:size]:
            return data[size:]
        _log.warning("%s is damaged (its digest differs): it is compiled again ...", path)
        with contextlib.suppress(OSError):
            Path(path).unlink()
        raise FileNotFoundError(path)


class _Cache(FunctionCache):
    """Machine code of an entry on disk; it is compiled again if the file cannot be read."""

    def __init__(self, py_func: Callable) -> None:
        super().__init__(py_func)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = _CheckedFiles(self._cache_path, self._impl.filename_base, stamp)

    def library(self, sig: tuple[types.Type, ...]) -> tuple[Any, Any, Any] | None:
        """Return machine code, description and environment for a signature; None: not on disk.

        Numba's `load_overload` also reads data for compiling callers: type rules (imports of 0.3 s)
        and the intermediate code (10 ms an entry).
        """
        context = cpu_target.target_context
        try:
            kept = self._cache_file.load(self._index_key(sig, context.codegen()))
        except (OSError, EOFError, pickle.UnpicklingError):
            return None
        if kept is None:
            return None
        (name, form, (machine_code, _)), description, environment, *_ = kept
        # numba reads the names that are defined from intermediate code: here empty functions
        defined = (
            description.llvm_func_name,
            description.llvm_cfunc_wrapper_name,
            description.llvm_cpython_wrapper_name,
        )
        named = "".join(f'define void @"{one}"() {{ ret void }}\n' for one in defined)
        code = (machine_code, llvm.parse_assembly(named).as_bitcode())
        library = context.codegen().unserialize_library((name, form, code))
        return library, description, environment

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the machine code for a signature, or None."""
        try:
            return super().load_overload(sig, target_context)
        # files can be damaged after a crash of the machine
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
            # shown once: Python ignores repeated warnings of the same line
            warnings.warn(
                f"machine code cannot be kept in {folder()} ({error.strerror}): every process "
                "compiles for up to half a minute; set NUMBA_CACHE_DIR to a writable folder",
                stacklevel=1,
            )


def kernel(function: Callable | None = None, *, inline: str | None = None) -> Any:
    """Compile a function that other kernels call.

    inline: "machine" merges its machine code into every caller, because a call passes a named tuple
        of arrays as a hundred scalars, which is too slow for inner loops. "source" copies its
        source into every caller and does not compile it alone.
    """
    # numba copies the source of its own functions only
    made = Kernel if inline != "source" else _numba_function
    compiled = functools.partial(
        made, options=INLINE_OPTIONS[inline] | {"no_cpython_wrapper": True}
    )
    return compiled if function is None else compiled(function)


def entry(function: Callable | None = None, *, inline: str | None = None) -> Any:
    """Compile a function that Python and other kernels call.

    inline: see `kernel`; "never" makes a C function, which compiled code calls by its `address`.
    """
    compiled = functools.partial(Entry, options=INLINE_OPTIONS[inline])
    return compiled if function is None else compiled(function)


def _numba_function(function: Callable, options: dict[str, Any]) -> Any:
    fixed = {"error_model": "numpy", "fastmath": {"contract"}, "no_cfunc_wrapper": True}
    return njit(_nrt=False, **fixed | options)(function)


class Kernel:
    """A function that numba compiles when one of its callers is compiled."""

    def __init__(self, function: Callable, options: dict[str, Any]) -> None:
        self.py_func = function
        self.name = function.__name__
        self.options = options
        self.__doc__, self.__module__ = function.__doc__, function.__module__

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Function of numba, not yet compiled."""
        return _numba_function(self.py_func, self.options)

    @property
    def _numba_type_(self) -> Any:
        return self.dispatcher._numba_type_  # compiled callers see numba's function


class Entry(Kernel):
    """A compiled function that checks its arrays when Python calls it (by position)."""

    all: ClassVar[list["Entry"]] = []

    def __init__(self, function: Callable, options: dict[str, Any]) -> None:
        # other threads run while it computes
        super().__init__(function, options | {"nogil": True})
        Entry.all.append(self)

    @functools.cached_property
    def cache(self) -> _Cache | None:
        """Cache of machine code on disk, or None."""
        if folder() is None:
            return None
        before = config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = str(folder()), f"{__name__}.Locator"
        made = _Cache(self.py_func)
        config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = before
        return made

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Function of numba that searches the disk before it compiles."""
        made = super().dispatcher
        if self.cache is not None:
            made._cache = self.cache
        return made

    @property
    def signature(self) -> tuple[types.Type, ...]:
        """Numba's types of the arguments."""
        return tuple(_numba_type(form) for form in _forms(self.py_func))

    @functools.cached_property
    def _compiled(self) -> tuple[Any, Any, Callable]:
        """Machine code, its description and its function for Python, from disk if it is there."""
        found = self.cache and self.cache.library(self.signature)
        if found:
            return *found[:2], cpu_target.target_context.get_executable(*found)
        function = self.dispatcher.compile(self.signature)
        made = self.dispatcher.overloads[self.signature]
        return made.library, made.fndesc, function

    @property
    def ready(self) -> bool:
        """Whether this process has its machine code."""
        return "_compiled" in vars(self)

    @functools.cached_property
    def unchecked(self) -> Callable:
        """Machine code without the check of arrays, which takes some microseconds."""
        return self._compiled[2]

    @functools.cached_property
    def address(self) -> int:
        """Address of the machine code as a C function, for `call_function`."""
        library, description, _ = self._compiled
        return library.get_pointer_to_function(description.llvm_cfunc_wrapper_name)

    @functools.cached_property
    def kernel_address(self) -> int:
        """Address of the machine code as kernels call it, for `called_at_address`."""
        library, description, _ = self._compiled
        return library.get_pointer_to_function(description.llvm_func_name)

    def __call__(self, *arguments: Any) -> Any:
        """Check the arrays, then call the machine code; InvalidInputError names a wrong array."""
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


@intrinsic
def call_function(typing_context, address, arguments):
    """Call a C function that takes and returns 64-bit integers, pointers among them.

    Args:
        typing_context: numba's.
        address: of the function.
        arguments: tuple of integers.
    """

    def generate(context, builder, signature, values):
        word = ir.IntType(64)
        given = cgutils.unpack_tuple(builder, values[1], len(arguments))
        function = ir.FunctionType(word, [word] * len(given))
        return builder.call(builder.inttoptr(values[0], function.as_pointer()), given)

    return types.int64(types.int64, arguments), generate


@intrinsic
def placed(typing_context, arrays):
    """Return a named tuple, in whose field `here` its address is written.

    It lies on the stack of the entry that calls this: functions at addresses get one number in
    place of a hundred, see `taken_from`.
    """

    def generate(context, builder, signature, values):
        memory = cgutils.alloca_once(builder, values[0].type)
        here = builder.ptrtoint(memory, ir.IntType(64))
        filled = builder.insert_value(values[0], here, arrays.fields.index("here"))
        builder.store(filled, memory)
        return filled

    return arrays(arrays), generate


def taken_from(hint: Any) -> Any:
    """Return a function of kernels that reads a named tuple (its class is hint) at an address."""

    @intrinsic
    def take(typing_context, address):
        form = _numba_type(_Form("taken", hint))

        def generate(context, builder, signature, values):
            return builder.load(
                builder.inttoptr(values[0], context.get_value_type(form).as_pointer())
            )

        return form(types.int64), generate

    return take


def called_at_address(called: Entry, returns: type = int) -> Any:
    """Return a function of kernels that calls an entry without a copy of its machine code.

    Numba compiles a kernel again into every entry that calls it, directly or not. The returned
    function takes the `kernel_address` of the entry, which the caller must be given, and a tuple of
    the arguments.

    returns: type of what the entry returns, int or float.
    """
    result = SCALAR_TYPES[returns]

    @intrinsic
    def call(typing_context, address, arguments):
        if tuple(map(types.unliteral, arguments)) != called.signature:
            raise TypingError(f"{called.name} is called with {arguments}")

        def generate(context, builder, signature, values):
            convention, given = context.call_conv, signature.args[1].types
            form = convention.get_function_type(result, given)
            pointer = builder.inttoptr(values[0], form.as_pointer())
            unpacked = cgutils.unpack_tuple(builder, values[1])
            return convention.call_function(builder, pointer, result, given, unpacked)[1]

        return result(types.int64, arguments), generate

    return call


class _Form(NamedTuple):
    """Required type of an argument or of a field of a named tuple."""

    name: str
    hint: Any  # float, int, bool, class of a named tuple, or annotated array
    dtype: np.dtype | None = None  # of an array
    shape: tuple[int | str, ...] = ()  # of an array: numbers or names of sizes


@functools.cache
def _forms(annotated: Any) -> tuple[_Form, ...]:
    """Return the forms of a function's arguments or of a named tuple's fields, in order."""
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
    """Return numba's type for a form."""
    if form.dtype is not None:
        return types.Array(from_dtype(form.dtype), len(form.shape), "C")
    if form.hint in SCALAR_TYPES:
        return SCALAR_TYPES[form.hint]
    return types.BaseTuple.from_types(tuple(map(_numba_type, _forms(form.hint))), form.hint)


def check_arrays(arrays: NamedTuple) -> None:
    """Refuse a named tuple whose arrays do not fit its annotations or each other."""
    _check(arrays, _forms(type(arrays)), {}, type(arrays).__name__, 9)


def _check(
    values: tuple, forms: tuple[_Form, ...], letters: dict[str, int], where: str, depth: int
) -> None:
    """Compare values with their forms.

    Args:
        values: arguments of a call or fields of a named tuple.
        forms: their forms.
        letters: known sizes by letter in the whole call; new ones are added.
        where: name of the function or named tuple, for errors.
        depth: number of levels of named tuples that are checked.
    """
    words: dict[str, int] = {}
    for value, form in zip(values, forms, strict=True):
        if form.dtype is None:
            if depth > 0 and form.hint not in SCALAR_TYPES:
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
