"""Machine code from an object file into this process, and what it must be told of Python's objects."""

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np

NDARRAY = "cvqmpt_ndarray"
"""The variable through which machine code knows arrays."""


def loaded(code: bytes, symbols: tuple[str, ...]) -> dict[str, Callable[[tuple], Any]]:
    """Functions of an object file, ready to be called with a tuple of arguments."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    # By these names numba means the objects, C the variables that hold them.
    for error in (TypeError, RuntimeError):
        llvm.add_symbol(f"PyExc_{error.__name__}", id(error))
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    ctypes.c_int64.from_address(engine.get_global_value_address(NDARRAY)).value = id(np.ndarray)
    prototype = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object)
    functions: dict[str, Any] = {symbol: prototype(engine.get_function_address(symbol)) for symbol in symbols}
    for call in functions.values():
        call.engine = engine  # lives as long as its code can be called
    return functions
