"""Numbers, names, lengths, angles, arrays of json or calls: read, or refused by field's path."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Annotated, Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from cvqmpt_lab.base.errors import InvalidInputError, shown

Kept = TypeVar("Kept")
FloatArray: TypeAlias = npt.NDArray[np.float64]
TURN = 2.0 * np.pi  # [rad]; larger angles are degrees
LARGEST = 1e6  # [m] of a length or a coordinate: more is a misplaced unit, whose powers overflow


def frozen(value: Kept) -> Kept:
    """The value itself; arrays that it or its tuples hold can no longer be written to."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, tuple):
        for part in value:
            frozen(part)
    return value


def scalar(kind: type, value: Any, where: str) -> Any:
    """A number, text or boolean."""
    abstract = {float: Real, int: Integral}.get(kind, kind)
    if isinstance(value, abstract) and isinstance(value, bool) == (kind is bool):
        with contextlib.suppress(OverflowError):
            made = kind(value)
            if kind is int and made < 0:
                raise InvalidInputError(f"{where} is {shown(value)}; it cannot be negative")
            if kind is not float or math.isfinite(made):
                return made + 0.0 if kind is float else made  # -0.0 becomes 0.0
    must = "a finite float" if kind is float else kind.__name__
    raise InvalidInputError(f"{where} is {shown(value)}; it must be {must}")


def numbers(value: Any, where: str, what: str = "numbers") -> FloatArray:
    """A float copy of an array or nested lists of numbers; not of text, booleans, ragged lists."""
    try:
        if not isinstance(value, np.ndarray):
            entries = np.array(value, dtype=object).ravel()
            kinds = set(map(type, entries)) - {float, int}
            if not all(issubclass(kind, Real) and kind is not bool for kind in kinds):
                raise TypeError
        return np.array(value, dtype=float) + 0.0  # + 0.0 turns -0.0 into 0.0: one form per value
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidInputError(f"{where} is {shown(value)}; it must be {what}") from error


@dataclass(frozen=True)
class Condition:
    """A scalar that meets a condition."""

    kind: type  # float, int or str
    holds: Callable[[Any], bool]
    must: str  # the condition, after "it must be"

    def read(self, value: Any, where: str) -> Any:
        """Refuse a value without the condition."""
        value = scalar(self.kind, value, where)
        if not self.holds(value):
            raise InvalidInputError(f"{where} is {shown(value)}; it must be {self.must}")
        return value


@dataclass(frozen=True)
class Array:
    """Finite numbers of a shape, read as a read-only array."""

    shape: tuple[int | None, ...]  # None for any length
    what: str = "numbers"  # what they are, with the unit
    largest: float = np.inf  # number that is understood, either sign

    def read(self, value: Any, where: str) -> FloatArray:
        """Refuse another shape, NaN and infinity."""
        array = numbers(value, where, self.what)
        fits = len(array.shape) == len(self.shape)
        if not fits or any(
            w not in (None, n) for w, n in zip(self.shape, array.shape, strict=True)
        ):
            lengths = ", ".join("any" if n is None else str(n) for n in self.shape)
            must = f"({lengths}) {self.what}"
            raise InvalidInputError(f"{where} has shape {array.shape}; it must be {must}")
        if not np.isfinite(array).all():
            index = ", ".join(str(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise InvalidInputError(f"{where}[{index}] is NaN or infinite; it must be finite")
        if (most := np.abs(array).max(initial=0.0)) > self.largest:
            raise InvalidInputError(
                f"{where} holds {most:.3g}, more than {self.largest:g}; give metres"
            )
        return frozen(array)

    def write(self, value: FloatArray) -> list:
        """Nested lists."""
        return value.tolist()


Name = Annotated[
    str,
    Condition(
        str, lambda s: 0 < len(s) <= 200 and s.isprintable(), "1 to 200 printable characters"
    ),
]
Length = Annotated[
    float,
    Condition(float, lambda x: 0.0 < x <= LARGEST, f"a positive length, up to {LARGEST:g} [m]"),
]
Mass = Annotated[
    float, Condition(float, lambda x: 0.0 < x <= 1e3, "a mass above 0, up to 1000 [kg]")
]
Padding = Annotated[
    float,
    Condition(
        float, lambda x: 0.0 <= x <= LARGEST, f"a length of 0 or more, up to {LARGEST:g} [m]"
    ),
]
Angle = Annotated[
    float,
    Condition(
        float,
        lambda x: 0.0 <= x <= TURN,
        "from 0 to 2 pi [rad]: degrees? 10 degrees are 0.1745 rad",
    ),
]
