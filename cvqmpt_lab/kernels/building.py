"""Compiling kernels with numba: several of them and all they call become one object file. Nothing else imports numba.

Numba would make machine code of every kernel, once on its own and once more inside everything that calls it, and a
wrapper that takes its arguments from Python. Here its modules are linked before they are optimised, and only what
Python calls gets a wrapper, of our own: it reads arrays where numpy keeps them, and needs nothing of numba when it
runs.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, get_type_hints

from llvmlite import ir
from numba import from_dtype, typeof, types
from numba.core import cgutils
from numba.core.codegen import AOTCodeLibrary, JITCPUCodegen
from numba.core.compiler_lock import global_compiler_lock
from numba.core.cpu import CPUContext
from numba.core.registry import cpu_target
from numba.np.numpy_support import as_dtype

from cvqmpt_lab.kernels.annotations import Compilable, Dispatched, array_of
from cvqmpt_lab.kernels.loading import NDARRAY, loaded

WORD, OBJECT = ir.IntType(64), ir.IntType(8).as_pointer()
DATA, AXES, SHAPE, STRIDES, DESCRIPTION, FLAGS = 16, 24, 32, 40, 56, 64  # bytes into numpy's array object
TYPE, KIND = 8, 28  # bytes into any object, to its type; into numpy's description, to the number of its type
CONTIGUOUS = 1  # of the flags
MISMATCH = "an array in a bundle has another type, number of axes or order than its annotation says"


class _Library(AOTCodeLibrary):
    """Modules that are optimised once all are together."""

    whole = False

    def _optimize_final_module(self) -> None:
        if self.whole:
            super()._optimize_final_module()


class _Codegen(JITCPUCodegen):
    """For this processor, but nothing is run."""

    _library_class = _Library

    def _add_module(self, module: Any) -> None:
        pass


@functools.cache
def _codegen() -> _Codegen:
    return _Codegen("kernels")


@contextlib.contextmanager
def _numba_makes_no_machine_code() -> Iterator[CPUContext]:
    """Let what numba compiles meanwhile go through our code generator; the target context."""
    context = cpu_target.target_context
    before = context._internal_codegen
    with global_compiler_lock:
        context._internal_codegen = _codegen()
        context.get_executable = lambda library, fndesc, env: (
            object().__dir__
        )  # a key of its own; nobody calls it
        try:
            yield context
        finally:
            context._internal_codegen = before
            del context.get_executable


def build(entries: Sequence[Compilable]) -> bytes:
    """Compile entries, whose annotations say their types, into one object file."""
    return _object_file([(entry.symbol, entry.kernel, _argument_types(entry)) for entry in entries])


def call_compiled(kernel: Dispatched, arguments: tuple) -> Any:
    """Call a kernel that is no entry, compiled for the types of these arguments."""
    return _compiled(kernel, tuple(typeof(argument) for argument in arguments))(arguments)


@functools.cache
def _compiled(kernel: Dispatched, argument_types: tuple[types.Type, ...]) -> Callable[[tuple], Any]:
    return loaded(_object_file([("kernel", kernel, argument_types)]), ("kernel",))["kernel"]


def type_of_intrinsic(intrinsic: Any) -> types.Type:
    """Numba's type of an intrinsic."""
    typing = cpu_target.typing_context
    typing.refresh()
    return typing.resolve_value_type(intrinsic)


def _argument_types(entry: Compilable) -> tuple[types.Type, ...]:
    hints = get_type_hints(entry.kernel.py_func, include_extras=True)
    return tuple(_numba_type(hints[name]) for name in entry.names)


def _numba_type(hint: Any) -> types.Type:
    """Numba's type of what an annotation describes."""
    if hint in SCALARS:
        return SCALARS[hint]
    if hasattr(hint, "_fields"):
        hints = get_type_hints(hint, include_extras=True)
        return types.BaseTuple.from_types(tuple(_numba_type(hints[name]) for name in hint._fields), hint)
    array = array_of(hint)
    return types.Array(from_dtype(array.dtype), len(array.shape), "C")


SCALARS = {float: types.float64, int: types.int64, bool: types.boolean}


def _object_file(kernels: Sequence[tuple[str, Dispatched, tuple[types.Type, ...]]]) -> bytes:
    """Machine code of kernels for argument types, each called by its symbol with a tuple of arguments."""
    with _numba_makes_no_machine_code() as context:
        library = context.codegen().create_library("kernels")
        library.whole = True
        library.add_ir_module(_reader_of_arrays(library))
        for symbol, kernel, argument_types in kernels:
            kernel.dispatcher.compile(argument_types)
            compiled = kernel.dispatcher.overloads[argument_types]
            library.add_linking_library(compiled.library)
            library.add_ir_module(_Wrapper(context, library, symbol, compiled.fndesc).module)
        return library.emit_native_object()


def _reader_of_arrays(library: _Library) -> ir.Module:
    """A module with the function `read_array`: numpy's array object to numba's words, or an error of Python's."""
    module = library.create_ir_module("arrays")
    known = ir.GlobalVariable(module, WORD, NDARRAY)
    known.initializer = WORD(0)
    function = _declared_reader(module)
    function.attributes.add("noinline")
    array, axes, kind, out = function.args
    builder = ir.IRBuilder(function.append_basic_block())

    def field(base: ir.Value, offset: int, wanted: ir.Type) -> ir.Value:
        return builder.load(builder.bitcast(builder.gep(base, [WORD(offset)]), wanted.as_pointer()))

    number = ir.IntType(32)
    checks = (
        lambda: builder.icmp_unsigned("==", field(array, TYPE, WORD), builder.load(known)),
        lambda: builder.icmp_signed("==", field(array, AXES, number), axes),
        lambda: builder.icmp_signed("==", field(field(array, DESCRIPTION, OBJECT), KIND, number), kind),
        lambda: builder.icmp_signed(
            "!=", builder.and_(field(array, FLAGS, number), number(CONTIGUOUS)), number(0)
        ),
    )
    for check in checks:
        with builder.if_then(builder.not_(check()), likely=False):
            builder.ret(ir.IntType(1)(0))
    axes = builder.sext(axes, WORD)
    lengths, strides = field(array, SHAPE, WORD.as_pointer()), field(array, STRIDES, WORD.as_pointer())
    builder.store(field(array, DATA, WORD), builder.gep(out, [WORD(4)]))
    count = cgutils.alloca_once_value(builder, WORD(1))
    with cgutils.for_range(builder, axes) as loop:
        length = builder.load(builder.gep(lengths, [loop.index]))
        builder.store(builder.mul(builder.load(count), length), count)
        builder.store(length, builder.gep(out, [builder.add(loop.index, WORD(5))]))
        place = builder.add(builder.add(loop.index, axes), WORD(5))
        builder.store(builder.load(builder.gep(strides, [loop.index])), builder.gep(out, [place]))
    builder.store(builder.load(count), builder.gep(out, [WORD(2)]))
    builder.ret(ir.IntType(1)(1))
    return module


def _declared_reader(module: ir.Module) -> ir.Function:
    arguments = [OBJECT, ir.IntType(32), ir.IntType(32), WORD.as_pointer()]
    return ir.Function(module, ir.FunctionType(ir.IntType(1), arguments), "cvqmpt_read_array")


class _Wrapper:
    """The function of Python's that calls a kernel with a tuple of arguments."""

    def __init__(self, context: CPUContext, library: _Library, symbol: str, fndesc: Any) -> None:
        self.module = library.create_ir_module(symbol)
        self.reader = _declared_reader(self.module)
        function = ir.Function(self.module, ir.FunctionType(OBJECT, [OBJECT]), symbol)
        self.context, self.builder = context, ir.IRBuilder(function.append_basic_block())
        self.python = context.get_python_api(self.builder)
        values = self._members(fndesc.argtypes, function.args[0])
        with self.builder.if_then(
            cgutils.is_not_null(self.builder, self.python.err_occurred()), likely=False
        ):
            self.builder.ret(self.python.get_null_object())
        kernel = context.declare_function(self.module, fndesc)
        status, result = context.call_conv.call_function(
            self.builder, kernel, fndesc.restype, fndesc.argtypes, values
        )
        with self.builder.if_then(status.is_error, likely=False):
            self.python.err_set_string("PyExc_RuntimeError", f"kernel {symbol} failed")
            self.builder.ret(self.python.get_null_object())
        self.builder.ret(self._boxed(fndesc.restype, result))

    def _members(self, member_types: Sequence[types.Type], values: ir.Value) -> list[ir.Value]:
        """Members of a tuple; None stands for one that is missing, and is refused as what it should be."""
        found = []
        for place, member in enumerate(member_types):
            value = self.python.tuple_getitem(values, place)
            value = self.builder.select(
                cgutils.is_null(self.builder, value), self.python.borrow_none(), value
            )
            found.append(self._unboxed(member, value))
        return found

    def _unboxed(self, wanted: types.Type, value: ir.Value) -> ir.Value:
        """An object of Python's as numba has it, or an error set."""
        if isinstance(wanted, types.BaseTuple):
            return self.context.make_tuple(self.builder, wanted, self._members(tuple(wanted), value))
        if isinstance(wanted, types.Array):
            return self._array(wanted, value)
        if isinstance(wanted, types.Boolean):
            truth = self.python.object_istrue(value)
            return self.builder.icmp_signed("!=", truth, truth.type(0))
        if isinstance(wanted, types.Float):
            return self.context.cast(self.builder, self.python.float_as_double(value), types.float64, wanted)
        return self.context.cast(self.builder, self.python.long_as_longlong(value), types.int64, wanted)

    def _array(self, wanted: types.Array, value: ir.Value) -> ir.Value:
        out = cgutils.alloca_once(self.builder, self.context.get_value_type(wanted), zfill=True)
        dtype = as_dtype(wanted.dtype)
        number = ir.IntType(32)
        words = self.builder.bitcast(out, WORD.as_pointer())
        self.builder.store(WORD(dtype.itemsize), self.builder.gep(words, [WORD(3)]))
        good = self.builder.call(self.reader, [value, number(wanted.ndim), number(dtype.num), words])
        with self.builder.if_then(self.builder.not_(good), likely=False):
            self.python.err_set_string("PyExc_TypeError", MISMATCH)
        return self.builder.load(out)

    def _boxed(self, given: types.Type, value: ir.Value) -> ir.Value:
        """What numba has as an object of Python's."""
        given = types.unliteral(given)
        if isinstance(given, types.NoneType):
            return self.python.make_none()
        if isinstance(given, types.BaseTuple):
            parts = cgutils.unpack_tuple(self.builder, value, len(tuple(given)))
            members = [self._boxed(part, item) for part, item in zip(tuple(given), parts, strict=True)]
            packed = self.python.tuple_pack(members)
            for member in members:
                self.python.decref(member)
            return packed
        if isinstance(given, types.Boolean):
            return self.python.bool_from_bool(value)
        if isinstance(given, types.Float):
            return self.python.float_from_double(self.context.cast(self.builder, value, given, types.float64))
        return self.python.long_from_longlong(self.context.cast(self.builder, value, given, types.int64))
