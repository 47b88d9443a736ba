"""How kernels are marked: one decorator, `kernel`, with our options. Nothing here imports numba.

Division is IEEE's, and a product and a sum may be fused into one instruction (a quarter of forward kinematics).
Kernels make no arrays: those that they fill are handed to them. Numba's reference counting would cost more than the
arithmetic of the hot path (residual and Jacobian of a region: 3.7 us with it, 0.7 us without), and would have to be
loaded with the machine code.
"""

import functools
from collections.abc import Callable
from typing import Any

INLINE: dict[str | None, dict] = {
    None: {},
    "machine": {"forceinline": True},
    "source": {"inline": "always"},
}
OPTIONS = {
    "error_model": "numpy",
    "fastmath": {"contract"},
    "no_cfunc_wrapper": True,
    "no_cpython_wrapper": True,
    "_nrt": False,
}


class Kernel:
    """A function that other kernels call as machine code. What planning calls from Python is an `entry` besides."""

    def __init__(self, function: Callable, options: dict[str, Any]) -> None:
        self.py_func, self.targetoptions = (
            function,
            options,
        )  # numba looks for these names where it pastes sources
        functools.update_wrapper(self, function)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """What numba makes of the function; asked for by `building` alone."""
        from numba import njit

        return njit(**self.targetoptions)(self.py_func)

    @property
    def _numba_type_(self) -> Any:
        return self.dispatcher._numba_type_

    def __call__(self, *arguments: Any) -> Any:
        """Call it from Python, compiled for these arguments and kept nowhere: for tests and measurements."""
        from cvqmpt_lab.kernels.building import call_compiled

        return call_compiled(self, arguments)


def kernel(function: Callable | None = None, *, inline: str | None = None) -> Any:
    """Compile a function.

    Parameters
    ----------
    inline: "machine" merges its machine code into every caller: a bundle of arrays is passed as some hundred
        scalars, which a call in the hot path cannot afford. "source" pastes it into its callers before anything is
        compiled, which spares compiling it on its own.
    """
    if function is None:
        return functools.partial(kernel, inline=inline)
    return Kernel(function, OPTIONS | INLINE[inline])


def made_by_numba(make: Callable[[], Any]) -> Any:
    """See `MadeByNumba`."""
    return MadeByNumba(make)


class MadeByNumba:
    """What `make` returns, an intrinsic of numba, made when the first kernel that calls it is compiled."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self._make = make

    @functools.cached_property
    def _numba_type_(self) -> Any:
        from cvqmpt_lab.kernels.building import type_of_intrinsic

        return type_of_intrinsic(self._make())
