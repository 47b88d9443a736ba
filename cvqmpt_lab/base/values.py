"""Check numbers, names, lengths, angles and arrays; errors begin with the path of the field."""

import contextlib
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Annotated, Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from cvqmpt_lab.base.errors import InvalidInputError, shown

Kept = TypeVar("Kept")
FloatArray: TypeAlias = npt.NDArray[np.float64]
FULL_TURN_RAD = 2.0 * np.pi  # larger angles are refused: probably degrees
MAX_LENGTH_M = 1e6  # larger lengths and coordinates are refused: wrong unit, and powers overflow


def frozen(value: Kept) -> Kept:
    """Return the value; arrays in it, also inside tuples, are made read-only."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, tuple):
        for part in value:
            frozen(part)
    return value


NORMALISED = 100.0  # LeRobot's joint values go from -100 to 100, those of a gripper from 0


def other_units(values: FloatArray | Sequence[float]) -> str:
    """Return the question about units of joint values that are far outside their limits."""
    if np.abs(values).max(initial=0.0) > NORMALISED:
        return "degrees? Give radians"
    return "degrees, or LeRobot's normalised values of -100 to 100? Give radians"


def scalar(kind: type, value: Any, where: str) -> Any:
    """Return `value` as a `kind`: float, int, str or bool; refuse another type, NaN, int < 0."""
    if type(value) is kind is float and math.isfinite(value):  # most values; the rest takes longer
        return value + 0.0
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
    """Return an array or nested lists as a float copy; refuse text, booleans and ragged lists."""
    try:
        if not isinstance(value, np.ndarray):
            entries = np.array(value, dtype=object).ravel()
            kinds = set(map(type, entries)) - {float, int}
            if not all(issubclass(kind, Real) and kind is not bool for kind in kinds):
                raise TypeError
        elif value.dtype.kind == "c":  # numpy drops the imaginary part
            raise TypeError
        return np.array(value, dtype=float) + 0.0  # + 0.0 turns -0.0 into 0.0: one form per value
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidInputError(f"{where} is {shown(value)}; it must be {what}") from error


def bound_text(bound: float, up: bool, digits: int = 2) -> str:
    """Return a bound with a number of digits, rounded up or down so that it is still a bound."""
    text = f"{bound:.{digits}g}"
    if (float(text) < bound) if up else (float(text) > bound):
        half = 0.5 * 10.0 ** (math.floor(math.log10(abs(bound))) - digits + 1)
        text = f"{bound + (half if up else -half):.{digits}g}"
    return text


BOUNDS: Mapping[str, Callable[[Any, float], bool]] = {
    "minimum": operator.ge,
    "exclusiveMinimum": operator.gt,
    "maximum": operator.le,
    "exclusiveMaximum": operator.lt,
    "minLength": lambda text, least: len(text) >= least,
    "maxLength": lambda text, most: len(text) <= most and text.isprintable(),
}
"""Conditions on a scalar by their keyword in JSON schemas."""


@dataclass(frozen=True, eq=False)
class Condition:
    """Form of a scalar that keeps bounds."""

    kind: type  # float, int or str
    bounds: Mapping[str, float]  # by a keyword of `BOUNDS`
    must: str  # the bounds in words, for messages: "it must be ..."

    def read(self, value: Any, where: str) -> Any:
        """Return the value; refuse one outside the bounds."""
        value = scalar(self.kind, value, where)
        for keyword, bound in self.bounds.items():
            if not BOUNDS[keyword](value, bound):
                raise InvalidInputError(f"{where} is {shown(value)}; it must be {self.must}")
        return value

    def schema(self, schema_of: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        """Return the JSON schema."""
        return {**schema_of(self.kind), **self.bounds}


@dataclass(frozen=True)
class Array:
    """Form of an array: finite numbers of a shape, read-only after reading."""

    shape: tuple[int | None, ...]  # None for any length
    what: str = "numbers"  # description with the unit, for messages
    largest: float = np.inf  # largest valid absolute value

    def read(self, value: Any, where: str) -> FloatArray:
        """Return the array; refuse another shape, NaN and infinity."""
        array = numbers(value, where, self.what)
        fits = array.shape == self.shape or (
            len(array.shape) == len(self.shape)
            and all(w in (None, n) for w, n in zip(self.shape, array.shape, strict=True))
        )
        if not fits:
            lengths = ", ".join("any" if n is None else str(n) for n in self.shape)
            must = f"({lengths}) {self.what}"
            raise InvalidInputError(f"{where} has shape {array.shape}; it must be {must}")
        if not np.isfinite(array).all():
            index = ", ".join(str(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise InvalidInputError(f"{where}[{index}] is NaN or infinite; it must be finite")
        bounded = self.largest < np.inf
        if bounded and (most := np.abs(array).max(initial=0.0)) > self.largest:
            raise InvalidInputError(
                f"{where} holds {most:.3g}, more than {self.largest:g}; give metres"
            )
        return frozen(array)

    def write(self, value: FloatArray) -> list:
        """Return the array as nested lists."""
        return value.tolist()

    def schema(self, schema_of: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        """Return the JSON schema: lists within lists."""
        found = schema_of(float)
        for length in reversed(self.shape):
            found = {"type": "array", "items": found}
            if length is not None:
                found |= {"minItems": length, "maxItems": length}
        return found


Name = Annotated[
    str,
    Condition(str, {"minLength": 1, "maxLength": 200}, "1 to 200 printable characters"),
]
Length = Annotated[
    float,
    Condition(
        float,
        {"exclusiveMinimum": 0.0, "maximum": MAX_LENGTH_M},
        f"a positive length, up to {MAX_LENGTH_M:g} [m]",
    ),
]
Mass = Annotated[
    float,
    Condition(float, {"exclusiveMinimum": 0.0, "maximum": 1e3}, "a mass above 0, up to 1000 [kg]"),
]
Padding = Annotated[
    float,
    Condition(
        float,
        {"minimum": 0.0, "maximum": MAX_LENGTH_M},
        f"a length of 0 or more, up to {MAX_LENGTH_M:g} [m]",
    ),
]
Angle = Annotated[
    float,
    Condition(
        float,
        {"minimum": 0.0, "maximum": FULL_TURN_RAD},
        "from 0 to 2 pi [rad]: degrees? 10 degrees are 0.1745 rad",
    ),
]
