"""Constraints of the user's own: any F(q), as Python, numba or torch functions."""

import inspect
import time
from collections.abc import Callable, Mapping
from functools import cache, cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError
from cvqmpt_lab.base.modules import described
from cvqmpt_lab.base.polyline import step_lengths
from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.constraints.constraint import Constraint, Evaluated
from cvqmpt_lab.constraints.regions import FunctionRows

Bound = float | Callable[[np.ndarray, np.ndarray], float]


class FunctionConstraint(Constraint):
    """A constraint F(q) = 0 of the user's own, beside or instead of regions.

    Functions take q as (n,) and return (dim,); faster are those that also take (b, n) and return
    (b, dim). A function that numba compiled, and its Jacobian, run at machine speed. They take one
    state, or write into an array: ``F(q, out)`` with out (dim,), ``J(q, out)`` with out (dim, n).
    They fail at a state where they raise an error.

    Args:
        dim: number of entries of F, fewer than the robot has joints.
        residual: F.
        jacobian: dF/dq (dim, n), or (b, dim, n); None: central differences.
        bound: a Lipschitz constant of every entry of F [units per rad or m of the joints together],
            or a function of two states (n,) that returns by how much the largest ``|F_i|`` between
            them can exceed its larger value at both. With it, motions are proven; without, checked.
        name: what reports call it; the name of the function if it is empty.
        units: of F, for reports.
    """

    # where problem files and other processes find it: address and fields
    source: tuple[str, Mapping[str, Any]] | None = None
    # function that returns it for these two, in other processes
    load: Callable[[str, Mapping[str, Any]], "FunctionConstraint"] | None = None

    def __init__(
        self,
        dim: int,
        residual: Callable[..., Any],
        jacobian: Callable[..., Any] | None = None,
        bound: Bound | None = None,
        name: str = "",
        units: str = "rad or m",
    ) -> None:
        self._dim, self._function, self._derivative, self._bound = dim, residual, jacobian, bound
        self.name, self.units = name or getattr(residual, "__name__", "F"), units
        self._takes_batches: dict[Any, bool] = {}
        self.accepted: set[Any] = set()  # robots and starts for which it passed all checks
        if not callable(residual) or not (jacobian is None or callable(jacobian)):
            raise InvalidInputError(f"constraint {self.name}: residual and jacobian are functions")
        if isinstance(dim, bool) or not isinstance(dim, int) or dim < 1:
            raise InvalidInputError(f"constraint {self.name}: dim is {dim!r}; give 1 or more")
        if isinstance(bound, int | float) and not 0.0 < bound < np.inf:
            raise InvalidInputError(
                f"constraint {self.name}: bound is {bound:g}; give a Lipschitz constant above 0"
            )
        if self.compiled and jacobian is not None and not hasattr(jacobian, "py_func"):
            raise InvalidInputError(f"constraint {self.name}: compile its Jacobian by numba, too")

    @property
    def dim(self) -> int:
        """Number of entries of F."""
        return self._dim

    @property
    def bound(self) -> Bound | None:
        """The bound that was given."""
        return self._bound

    @property
    def compiled(self) -> bool:
        """Whether numba compiled F."""
        return hasattr(self._function, "py_func")

    @property
    def by_differences(self) -> bool:
        """Whether dF/dq is computed by central differences."""
        return self._derivative is None

    def describe(self) -> str:
        """Return name, size and units."""
        entries = "1 entry" if self.dim == 1 else f"{self.dim} entries"
        return f"{self.name} = 0 ({entries} [{self.units}])"

    @property
    def code(self) -> str:
        """Source of F, its Jacobian and a bound that is a function, with their names."""
        given = self._function, self._derivative, self._bound
        return "".join(source_of(one) for one in given if callable(one))

    def price(self, q: np.ndarray, calls: int = 20) -> str:
        """Return how F is called, in words, with its time at q (n,), the best of three times."""
        slopes = "; Jacobian by central differences" if self.by_differences else ""
        if self.compiled:
            return f"compiled by numba{slopes}"
        times = []
        for _ in range(3):
            began = time.perf_counter()
            for _ in range(calls):
                self.own_residual(q)
            times.append((time.perf_counter() - began) / calls)
        return f"Python, {1e6 * min(times):.3g} µs a call{slopes}"

    def residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q), (dim,) or (b, dim), by machine code where it exists."""
        if not self.compiled:
            return self.own_residual(q)
        return self._filled(self._in_place[0], np.asarray(q), (self.dim,))

    def own_residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q), (dim,) or (b, dim), by the user's Python function."""
        own = getattr(self._function, "py_func", self._function)
        fills = self.compiled and self._in_place[0] is self._function
        return (self._filled if fills else self._called)(own, np.asarray(q), (self.dim,))

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return dF/dq, (dim, n) or (b, dim, n)."""
        q = np.asarray(q, dtype=float)
        shape = (self.dim, q.shape[-1])
        if self._derivative is None:
            return differences(self.residual, q)
        if self.compiled:
            return self._filled(self._in_place[1], q, shape)
        return self._called(self._derivative, q, shape)

    def for_one_state(self) -> tuple[Evaluated, Evaluated]:
        """Return the user's own functions; without a Jacobian, one call computes F and dF/dq.

        Newton's method needs dF/dq after every F but the last one, and converges quadratically: F
        after a step from an entry above 0.01 is computed with the states around it.
        """
        function, shape = self._function, (self.dim,)
        if self._derivative is not None:
            return function, self._derivative
        far, stepping, found = False, False, (b"", np.empty(0))

        def with_slopes(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            values = self._called(function, around(q), shape)
            return values[0], slopes_of(values)

        def residual(q: np.ndarray) -> np.ndarray:
            nonlocal far, stepping, found
            if far and stepping and self._takes_batches.get(function):
                F, slopes = with_slopes(q)
                found = q.tobytes(), slopes
            else:
                F = np.asarray(function(q), dtype=float)
            far, stepping = max(map(abs, F.ravel().tolist())) > 0.01, False
            return F

        def jacobian(q: np.ndarray) -> np.ndarray:
            nonlocal stepping
            stepping = True
            return found[1] if found[0] == q.tobytes() else with_slopes(q)[1]

        return residual, jacobian

    def bound_between(self, states: np.ndarray) -> np.ndarray | None:
        """Return by how much F can exceed its larger value at both ends, (k - 1,), see `bound`."""
        if self._bound is None:
            return None
        if callable(self._bound):
            try:
                return np.array([float(self._bound(a, b)) for a, b in pairwise(states)])
            except Exception as error:
                raise InvalidInputError(
                    f"constraint {self.name}: bound raises {described(error)}; it takes two states "
                    "(n,) and returns a number"
                ) from error
        return 0.5 * self._bound * step_lengths(states)

    def reraise(self) -> None:
        """Raise what Python code raised inside compiled code; functions of numba raise nothing."""
        if not self.compiled:
            self._told(self._function, super().reraise)

    @property
    def rows(self) -> FunctionRows:
        """The function at an address: machine code, or a callback."""
        if not self.compiled:
            return super().rows
        none = np.zeros(self.dim)
        return FunctionRows(self._machine_code.address, none, none)

    @cached_property
    def _machine_code(self) -> Any:
        return machine_code(*self._in_place)

    @cached_property
    def _in_place(self) -> tuple[Any, Any]:
        """Compiled F and J as functions (q, out)."""
        return in_place(self._function), in_place(self._derivative)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields that another process can use, which checks them again."""
        kept = {**super().__getstate__(), "accepted": set()}
        kept.pop("_machine_code", None)
        kept.pop("_in_place", None)
        return kept

    def __reduce_ex__(self, protocol: Any) -> Any:
        if self.source is not None:
            return self.load, self.source
        return super().__reduce_ex__(protocol)

    def _told(self, function: Any, call: Callable[..., Any], *given: np.ndarray) -> Any:
        """Return call(*given); an error of a user's function names it."""
        try:
            return call(*given)
        except CvqmptError:
            raise
        except Exception as error:
            what = "its Jacobian" if function is self._derivative else "F"
            raise InvalidInputError(
                f"constraint {self.name}: {what} raises {described(error)}"
            ) from error

    def _filled(self, function: Any, q: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Return what a function (q, out) of one state writes, for q (n,) or (b, n)."""
        out = np.empty((*q.shape[:-1], *shape))
        for one, row in zip(np.atleast_2d(q), out.reshape(-1, *shape), strict=True):
            self._told(function, function, np.ascontiguousarray(one, dtype=float), row)
        return out

    def _called(self, function: Any, q: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Return what a function of one state or several returns, for q (n,) or (b, n)."""
        if q.ndim == 1:
            return self._value(function, q, shape)
        if len(q) == 0:
            return np.empty((0, *shape))
        if function not in self._takes_batches:
            self._takes_batches[function] = self._batches(function, q[0], shape)
        if self._takes_batches[function]:
            return self._value(function, q, (len(q), *shape))
        return np.array([self._value(function, one, shape) for one in q])

    def _value(self, function: Any, q: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        if q.flags.writeable:  # a function that changes its argument is told so
            q = q.copy()
            q.flags.writeable = False
        value = self._told(function, lambda at: _real(function(at)), q)
        if value.shape == shape:
            return value
        if value.size != int(np.prod(shape)):
            what = "F" if function is self._function else "its Jacobian"
            raise InvalidInputError(
                f"constraint {self.name}: {what} has shape {value.shape}; needed: {shape}"
            )
        return value.reshape(shape)

    def _batches(self, function: Any, q: np.ndarray, shape: tuple[int, ...]) -> bool:
        """Return whether a function takes several states at once."""
        two = np.array([q, q + 0.1])
        alone = np.array([self._value(function, one, shape) for one in two])
        try:
            together = self._value(function, two, alone.shape)
        except Exception:  # made for one state
            return False
        return np.allclose(together, alone, equal_nan=True)


def _real(value: Any) -> np.ndarray:
    """Return what a user's function returned as floats; complex numbers are refused."""
    array = np.asarray(value)
    if array.dtype.kind == "c":
        raise TypeError("complex numbers are returned; return real ones")
    return array.astype(float, copy=False)


def source_of(function: Any) -> str:
    """Return module, name and source of a function, or its bytes where no file has the source."""
    own = inspect.unwrap(getattr(function, "py_func", function))
    named = own if hasattr(own, "__qualname__") else type(own)
    try:
        source = inspect.getsource(named)
    except (OSError, TypeError):
        source = _code_text(getattr(named, "__code__", None))
    return f"{named.__module__}:{named.__qualname__}\n{source}"


def _code_text(code: Any) -> str:
    """Return instructions, names and constants of a code object."""
    if not hasattr(code, "co_code"):
        return repr(code)
    return f"{code.co_code.hex()} {code.co_names} {[*map(_code_text, code.co_consts)]}"


def differences(function: Evaluated, q: np.ndarray) -> np.ndarray:
    """Return dF/dq by central differences, (dim, n) or (b, dim, n) of q (n,) or (b, n)."""
    moved = around(q)
    return slopes_of(function(moved.reshape(-1, q.shape[-1])).reshape(*moved.shape[:-1], -1))


def around(q: np.ndarray) -> np.ndarray:
    """Return q (..., n), and q with each joint moved ahead, then back, (..., 1 + 2 n, n)."""
    return frozen(q[..., None, :] + _steps(q.shape[-1]))


def slopes_of(values: np.ndarray) -> np.ndarray:
    """Return dF/dq (..., dim, n) of F (..., 1 + 2 n, dim) at the states of `around`."""
    n = values.shape[-2] // 2
    slopes: np.ndarray = values[..., 1 : n + 1, :] - values[..., n + 1 :, :]
    slopes /= 2.0 * _steps(n)[1, 0]
    return slopes.swapaxes(-1, -2)


@cache
def _steps(n: int) -> np.ndarray:
    step = 6e-6  # [rad or m] the cube root of the rounding error, of values about 1
    return step * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])


def in_place(function: Any) -> Any:
    """Return a function that numba compiled in the form (q, out); others as they are."""
    python = getattr(function, "py_func", None)
    if python is None or len(inspect.signature(python).parameters) == 2:
        return function
    import numba

    @numba.njit
    def filled(q, out):
        out[:] = function(q)

    return filled


def machine_code(residual: Any, jacobian: Any) -> Any:
    """Return a C function of numba, see `FunctionRows`, around functions F(q, out) and J(q, out).

    jacobian: None: central differences.
    """
    import numba
    from numba import carray, types

    words, pointers = [types.int64] * 3, [types.CPointer(types.float64)] * 5
    by_differences, step = jacobian is None, float(_steps(1)[1, 0])
    derivative_of = residual if by_differences else jacobian

    @numba.cfunc(types.int64(*words, *pointers))
    def called(derivative, n, m, q, rotation, translation, parameters, out):
        try:
            at = carray(q, (n,))
            if derivative == 0:
                residual(at, carray(out, (m,)))
            elif by_differences:
                moved, ahead, behind = at.copy(), np.empty(m), np.empty(m)
                slopes = carray(out, (m, n))
                for j in range(n):
                    moved[j] = at[j] + step
                    residual(moved, ahead)
                    moved[j] = at[j] - step
                    residual(moved, behind)
                    moved[j] = at[j]
                    for i in range(m):
                        slopes[i, j] = (ahead[i] - behind[i]) / (2.0 * step)
            else:
                derivative_of(at, carray(out, (m, n)))
        except Exception:
            return 1
        return 0

    return called


def torch_constraint(
    dim: int,
    function: Callable[[Any], Any],
    bound: Bound | None = None,
    name: str = "",
    units: str = "rad or m",
) -> FunctionConstraint:
    """Return the constraint of a torch function, whose Jacobian torch computes.

    Args:
        dim: number of entries of F.
        function: takes a tensor (n,) of float64, returns a tensor (dim,).
        bound: see `FunctionConstraint`.
        name: see `FunctionConstraint`.
        units: of F, for reports.
    """
    import torch  # a second to import

    slopes = torch.func.jacrev(function)

    def of(call: Any) -> Callable[[np.ndarray], np.ndarray]:
        several = torch.func.vmap(call)

        def evaluated(q: np.ndarray) -> np.ndarray:
            x = torch.from_numpy(np.array(q, dtype=float))
            with torch.no_grad():
                return (call(x) if q.ndim == 1 else several(x)).numpy()

        evaluated.__wrapped__ = call  # type: ignore[attr-defined] # whose source it has
        return evaluated

    name = name or getattr(function, "__name__", "F")
    return FunctionConstraint(dim, of(function), of(slopes), bound, name, units)
