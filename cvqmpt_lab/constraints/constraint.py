"""The interface of a constraint F(q) = 0 on configurations q of a robot (paper, section III).

A new constraint is one file with one class: `dim`, `residual`, `jacobian` and `describe`. It can be
projected onto (Algorithm 1), searched on (Algorithm 3, see `search.space`) and codes can be moved
towards it (Algorithm 2). With `bound_between` it can be proven between states. Compiled code calls
its Python functions by one address, or machine code of its own, see `rows`. `RegionConstraint` is
the constraint of task-space regions, and of functions beside them.
"""

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from numbers import Real
from typing import Any, Self

import numpy as np

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, shown
from cvqmpt_lab.base.modules import described
from cvqmpt_lab.constraints.regions import FunctionRows, Regions, no_regions
from cvqmpt_lab.robot.robot import Robot

Evaluated = Callable[[np.ndarray], np.ndarray]


class Constraint(ABC):
    """A constraint F(q) = 0, F: (n,) -> (m,)."""

    @property
    @abstractmethod
    def dim(self) -> int:
        """Number m of entries of F."""

    @abstractmethod
    def residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q): (m,) of q (n,), or (b, m) of q (b, n) [m, rad]."""

    @abstractmethod
    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return J(q) = dF/dq: (m, n) of q (n,), or (b, m, n) of q (b, n)."""

    @abstractmethod
    def describe(self) -> str:
        """Return the constraint in words, such as "rotation about y -0.1 to 0.1 rad"."""

    def own_residual(self, q: np.ndarray) -> np.ndarray:
        """Return F(q) for the certificate: not by code that planners run, where there is both."""
        return self.residual(q)

    def price(self, q: np.ndarray) -> str:
        """Return how the user's code is called, in words, timed at q (n,); "" without such code."""
        return ""

    @property
    def code(self) -> str:
        """Source of the user's own code, for digests; "" without such code."""
        return ""

    def bound_between(self, states: np.ndarray) -> np.ndarray | None:
        """Return how far F can stray on straight motions between neighbours of states (k, n).

        An array (k - 1,): the largest entry of |F| on motion i exceeds its larger value at both
        ends by at most entry i [m, rad]. None: no bound is known.
        """
        return None

    def proven_between(self, states: np.ndarray) -> np.ndarray | None:
        """Return `bound_between` (k - 1,); InvalidInputError for what bounds nothing."""
        what = f"constraint {self.describe()}: bound_between"
        try:
            found = self.bound_between(states)
            if found is None:
                return None
            bounds = real_values(found)
        except CvqmptError:
            raise
        except Exception as error:
            raise InvalidInputError(f"{what} raises {described(error)}") from error
        if bounds.shape != (len(states) - 1,):
            raise InvalidInputError(
                f"{what} has shape {bounds.shape}; needed: ({len(states) - 1},), one of each motion"
            )
        wrong = ~((bounds >= 0.0) & (bounds < np.inf))
        if wrong.any():
            k = int(wrong.argmax())
            raise InvalidInputError(
                f"{what} is {bounds[k]:g} from {states[k].tolist()} to {states[k + 1].tolist()}; "
                "it must be finite, and 0 or more"
            )
        return bounds

    @property
    def rows(self) -> FunctionRows:
        """The constraint as a function that compiled code calls by its address."""
        none = np.zeros(self.dim)
        return FunctionRows(self._calls.address, none, none)

    @cached_property
    def _calls(self) -> "PythonRows":
        return PythonRows(self)

    def for_one_state(self) -> tuple[Evaluated, Evaluated]:
        """Return functions of a read-only q (n,) for F(q) and J(q), which compiled code calls."""
        return self.residual, self.jacobian

    def on(self, robot: Robot) -> Self:
        """Return the constraint for a robot: itself."""
        return self

    def reraise(self) -> None:
        """Raise what the constraint's Python code raised inside compiled code, Ctrl-C included."""
        error, self._calls.error = self._calls.error, None
        if error is not None:
            raise error

    def inner_regions(self, inset: float = 0.0) -> Regions:
        """Return the constraint as compiled code takes it.

        inset: bounds are moved inwards by this much [m, rad].
        """
        return with_functions(no_regions(), [self.rows], inset)

    def residual_and_jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `residual` and `jacobian` of q (n,) or (b, n)."""
        return self.residual(q), self.jacobian(q)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields that another process can use: addresses are left out."""
        addresses = ("_calls", "regions", "_regions_alone")
        return {name: kept for name, kept in vars(self).items() if name not in addresses}


class PythonRows:
    """A constraint in Python that compiled code calls by `address`, see `FunctionRows`.

    Exceptions cannot cross compiled code: one is kept in `error`, and the call has failed. Until
    the error is taken away, every other call fails, too. The object must outlive its use.
    """

    def __init__(self, constraint: Constraint) -> None:
        self.error: BaseException | None = None
        call = self._call_of(constraint)
        words = [ctypes.c_int64] * 3 + [ctypes.c_void_p] * 5
        self._callback = ctypes.CFUNCTYPE(ctypes.c_int64, *words)(call)
        self.address: int = ctypes.cast(self._callback, ctypes.c_void_p).value or 0

    def _call_of(self, constraint: Constraint) -> Any:
        """Return the function that compiled code calls; it copies arrays to and from pointers."""
        residual, jacobian = constraint.for_one_state()

        def call(derivative: int, n: int, m: int, q: int, *pointers: int) -> int:
            if self.error is not None:
                return 1
            try:
                given = np.frombuffer(ctypes.string_at(q, 8 * n))  # read-only, and fast
                found = jacobian(given) if derivative else residual(given)
                values, size = real_values(found).tobytes(), m * n if derivative else m
                if len(values) != 8 * size:
                    raise InvalidInputError(
                        f"{constraint.describe()}: {'J' if derivative else 'F'} has "
                        f"{len(values) // 8} numbers at {given.tolist()}; needed: {size}"
                    )
                ctypes.memmove(pointers[-1], values, len(values))
                return 0
            except BaseException as error:
                self.error = error
                return 1

        return call


def real_values(value: Any) -> np.ndarray:
    """Return what a user's function returned as floats; TypeError for what are no real numbers."""
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value  # at once, as this runs at every call
    array = np.asarray(value)
    if array.dtype.kind not in "fiuO":
        kinds = {"c": "complex numbers", "b": "True or False"}
        what = kinds.get(array.dtype.kind, f"values of type {array.dtype}")
        raise TypeError(f"{what} are returned; return real numbers")
    if array.dtype.kind == "O" and not all(isinstance(one, Real) for one in array.flat):
        raise TypeError(f"{shown(value)} is returned; return real numbers")
    return array.astype(float, copy=False)


def with_functions(regions: Regions, functions: Sequence[FunctionRows], inset: float) -> Regions:
    """Return regions with functions beside them.

    inset: bounds of functions are moved inwards by this much, at most a tenth of their width.
    """
    k, counts = len(regions.link), [len(rows.lower) for rows in functions]
    lower = np.concatenate([rows.lower for rows in functions])
    upper = np.concatenate([rows.upper for rows in functions])
    moved = np.minimum(inset, 0.1 * (upper - lower))
    first = np.cumsum([0, *(len(rows.parameters) for rows in functions)])
    return regions._replace(
        region=np.concatenate([regions.region, np.repeat(k + np.arange(len(counts)), counts)]),
        axis=np.concatenate([regions.axis, np.full(sum(counts), -1)]),
        lower=np.concatenate([regions.lower, lower + moved]),
        upper=np.concatenate([regions.upper, upper - moved]),
        functions=np.column_stack([[rows.address for rows in functions], first[:-1]]),
        parameters=np.concatenate([rows.parameters for rows in functions]),
    )
