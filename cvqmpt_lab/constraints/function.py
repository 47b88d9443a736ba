"""Constraints of the user's own: any F(q), as Python, numba or torch functions."""

import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, cached_property
from itertools import pairwise
from numbers import Real
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, shown
from cvqmpt_lab.base.modules import described
from cvqmpt_lab.base.polyline import step_lengths
from cvqmpt_lab.base.values import frozen, numbers
from cvqmpt_lab.constraints.constraint import Constraint, Evaluated, real_values
from cvqmpt_lab.constraints.regions import FunctionRows

Bound = float | Callable[[np.ndarray, np.ndarray], float]
Limit = float | Sequence[float | None] | np.ndarray | None


class FunctionConstraint(Constraint):
    """A constraint F(q) = 0, or lower <= F(q) <= upper, of the user's own, or beside regions.

    With bounds, `residual` is the signed distance of F outside them, and 0 inside.

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
            them, or distance of an F_i outside its bounds, can exceed its larger value at both.
            With it, motions are proven; without, checked.
        name: what reports call it; the name of the function if it is empty.
        units: of F, for reports.
        lower: lower bound of all entries of F, or of each; None: no bound, or 0 without `upper`.
        upper: upper bound of all entries of F, or of each; None: no bound, or 0 without `lower`.
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
        units: str = "",
        lower: Limit = None,
        upper: Limit = None,
    ) -> None:
        self._dim, self._function, self._derivative = dim, residual, jacobian
        self.name, self.units = name or getattr(residual, "__name__", "F"), units
        self._takes_batches: dict[Any, bool] = {}
        self.accepted: set[Any] = set()  # robots and starts for which it passed all checks
        if not callable(residual) or not (jacobian is None or callable(jacobian)):
            raise InvalidInputError(f"constraint {self.name}: residual and jacobian are functions")
        if isinstance(dim, bool) or not isinstance(dim, int) or dim < 1:
            raise InvalidInputError(f"constraint {self.name}: dim is {dim!r}; give 1 or more")
        self._bound = self._read_bound(bound)
        self._keep_limits(lower, upper)
        if self.compiled and jacobian is not None and not hasattr(jacobian, "py_func"):
            raise InvalidInputError(f"constraint {self.name}: compile its Jacobian by numba, too")

    def _read_bound(self, bound: Any) -> Bound | None:
        """Return a bound as a float or function; refuse what bounds nothing."""
        if bound is None or callable(bound):
            return bound
        real = isinstance(bound, Real) and not isinstance(bound, bool)
        if not real or not 0.0 < float(bound) < np.inf:
            raise InvalidInputError(
                f"constraint {self.name}: bound is {shown(bound)}; give a Lipschitz constant above "
                "0, or a function of two states"
            )
        return float(bound)

    def _keep_limits(self, lower: Limit, upper: Limit) -> None:
        """Set lower and upper bounds (dim,) of F; refuse an entry that is not bounded."""
        if lower is None and upper is None:
            lower = upper = 0.0
        low, high = (
            self._read_limit(*given)
            for given in (("lower", lower, -np.inf), ("upper", upper, np.inf))
        )
        for k, (least, most) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
            if not (least <= most and least < np.inf and most > -np.inf):
                raise InvalidInputError(
                    f"constraint {self.name}: entry {k} of F is bounded by lower {least:g}, upper "
                    f"{most:g}; lower <= upper is needed"
                )
            if least == -np.inf and most == np.inf:
                raise InvalidInputError(
                    f"constraint {self.name}: entry {k} of F has neither a lower nor an upper "
                    "bound: leave it out"
                )
        self.lower, self.upper = low, high
        self.equation = not (low.any() or high.any())  # F(q) = 0

    def _read_limit(self, name: str, limit: Limit, free: float) -> np.ndarray:
        """Return one bound of each entry of F (dim,); `free` stands for None."""
        given: Any = free if limit is None else limit
        if isinstance(given, list | tuple):
            given = [free if one is None else one for one in given]
        where = f"constraint {self.name}: {name}"
        found = numbers(given, where).ravel()
        if len(found) not in (1, self.dim):
            raise InvalidInputError(
                f"{where} has {len(found)} numbers; give one, or one for each of the {self.dim} "
                "entries of F"
            )
        return frozen(np.broadcast_to(found, self.dim).copy())

    def within(self, lower: Limit = None, upper: Limit = None) -> "FunctionConstraint":
        """Return a copy with other bounds of F; None: its own bound remains."""
        made = object.__new__(type(self))  # copy() would load it again by its address
        vars(made).update(vars(self))
        if not self.equation:
            lower = self.lower if lower is None else lower
            upper = self.upper if upper is None else upper
        made._keep_limits(lower, upper)
        made.accepted = set()
        vars(made).pop("_calls", None)
        return made

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
        """Return name, bounds, size and units: "height >= 0.5 (1 entry [m])"."""
        entries = "1 entry" if self.dim == 1 else f"{self.dim} entries"
        units = f" [{self.units}]" if self.units else ""
        return f"{self._bounds_text()} ({entries}{units})"

    def _bounds_text(self) -> str:
        low, high = (_one_or_all(limits) for limits in (self.lower, self.upper))
        if np.array_equal(self.lower, self.upper):
            return f"{self.name} = {low}"
        if np.isneginf(self.lower).all():
            return f"{self.name} <= {high}"
        if np.isposinf(self.upper).all():
            return f"{self.name} >= {low}"
        return f"{low} <= {self.name} <= {high}"

    @property
    def code(self) -> str:
        """Source of F, its Jacobian and a bound that is a function, with their names."""
        given = self._function, self._derivative, self._bound
        code = "".join(source_of(one) for one in given if callable(one))
        return code if self.equation else f"{code}\nbounds {self._bounds_text()}"

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
        """Return F(q), (dim,) or (b, dim), by machine code where it exists; see `outside`."""
        return self.outside(self.values(q))

    def own_residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q), (dim,) or (b, dim), by the user's Python function; see `outside`."""
        return self.outside(self.own_values(q))

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return dF/dq, (dim, n) or (b, dim, n); entries inside bounds are 0."""
        slopes, wide = self.slopes(q), self.lower < self.upper
        if not wide.any():
            return slopes
        return np.where((wide & (self.residual(q) == 0.0))[..., None], 0.0, slopes)

    def outside(self, values: np.ndarray) -> np.ndarray:
        """Return the signed distance of F (..., dim) outside its bounds."""
        F: np.ndarray = values if self.equation else values - values.clip(self.lower, self.upper)
        return F

    def values(self, q: np.ndarray) -> np.ndarray:
        """Return what F returns, (dim,) or (b, dim), by machine code where it exists."""
        if not self.compiled:
            return self.own_values(q)
        return self._filled(self._in_place[0], np.asarray(q), (self.dim,))

    def own_values(self, q: np.ndarray) -> np.ndarray:
        """Return what F returns, (dim,) or (b, dim), by the user's Python function."""
        own = getattr(self._function, "py_func", self._function)
        fills = self.compiled and self._in_place[0] is self._function
        return (self._filled if fills else self._called)(own, np.asarray(q), (self.dim,))

    def slopes(self, q: np.ndarray) -> np.ndarray:
        """Return dF/dq, (dim, n) or (b, dim, n), also inside bounds."""
        q = np.asarray(q, dtype=float)
        shape = (self.dim, q.shape[-1])
        if self._derivative is None:
            return differences(self.values, q)
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
                F = real_values(function(q))
            beyond = self.outside(F.ravel()).tolist()
            far, stepping = max(map(abs, beyond)) > 0.01, False
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
            return np.array([self._bound_of(a, b) for a, b in pairwise(states)])
        return 0.5 * self._bound * step_lengths(states)

    def _bound_of(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return the bound between two states (n,); refuse one that bounds nothing."""
        try:
            found = real_values(self._bound(a, b))  # type: ignore[operator, misc] # is callable
            (said,) = found.ravel()
        except Exception as error:
            raise InvalidInputError(
                f"constraint {self.name}: bound raises {described(error)}; it takes two states "
                "(n,) and returns a number"
            ) from error
        if not 0.0 <= said < np.inf:
            raise InvalidInputError(
                f"constraint {self.name}: bound is {said:g} from {a.tolist()} to {b.tolist()}; it "
                "must be finite, and 0 or more; without a bound, leave it out"
            )
        return float(said)

    def reraise(self) -> None:
        """Raise what Python code raised inside compiled code; functions of numba raise nothing."""
        if not self.compiled:
            self._told(self._function, super().reraise)

    @property
    def rows(self) -> FunctionRows:
        """The function at an address: machine code, or a callback."""
        made = self._machine_code if self.compiled else self._calls
        return FunctionRows(made.address, self.lower, self.upper)

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
        out = np.full((*q.shape[:-1], *shape), np.nan)  # entries that it leaves out are found
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
        value = self._told(function, lambda at: real_values(function(at)), q)
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


def _one_or_all(limits: np.ndarray) -> str:
    """Return bounds (dim,) in words: one number if all are equal."""
    texts = [f"{limit:g}" for limit in limits.tolist()]
    return texts[0] if len(set(texts)) == 1 else f"[{', '.join(texts)}]"


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
    units: str = "",
    lower: Limit = None,
    upper: Limit = None,
) -> FunctionConstraint:
    """Return the constraint of a torch function, whose Jacobian torch computes.

    Args:
        dim: number of entries of F.
        function: takes a tensor (n,) of float64, returns a tensor (dim,).
        bound: see `FunctionConstraint`.
        name: see `FunctionConstraint`.
        units: of F, for reports.
        lower: see `FunctionConstraint`.
        upper: see `FunctionConstraint`.
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
    return FunctionConstraint(dim, of(function), of(slopes), bound, name, units, lower, upper)
