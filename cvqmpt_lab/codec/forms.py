"""Forms of values in json: conditions, arrays, unions of dataclasses, lists; see `plain`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from numbers import Real
from types import GenericAlias
from typing import Annotated, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from cvqmpt_lab.codec.plain import at, from_plain, mapping, to_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError, shown

FloatArray: TypeAlias = npt.NDArray[np.float64]
Schema: TypeAlias = Callable[[Any], dict[str, Any]]
TURN = 2.0 * np.pi  # [rad]; larger angles are degrees
LARGEST = 1e6  # [m] of a length or a coordinate: more is a misplaced unit, whose powers overflow


@dataclass(frozen=True)
class Condition:
    """A value of a plain kind that meets a condition."""

    kind: Any
    holds: Callable[[Any], bool]
    must: str  # the condition, after "it must be"
    keywords: Mapping[str, Any]  # the condition as json schema

    def read(self, value: Any, where: str) -> Any:
        """Refuse a value without the condition."""
        value = from_plain(self.kind, value, where)
        if not self.holds(value):
            raise InvalidInputError(f"{where} is {shown(value)}; it must be {self.must}")
        return value

    def write(self, value: Any) -> Any:
        """The value itself."""
        return to_plain(value, self.kind)

    def schema(self, of: Schema) -> dict[str, Any]:
        """That of the plain value, and the condition."""
        return of(self.kind) | dict(self.keywords)


@dataclass(frozen=True)
class Array:
    """Finite numbers of a shape, read as a read-only array."""

    shape: tuple[int | None, ...]  # None for any length
    what: str = "numbers"  # what they are, with the unit
    largest: float = np.inf  # number that is understood, either sign

    def read(self, value: Any, where: str) -> FloatArray:
        """Refuse another shape, NaN and infinity."""
        array = numbers(value, where, self.what)
        if len(array.shape) != len(self.shape) or any(
            wanted not in (None, n) for wanted, n in zip(self.shape, array.shape, strict=True)
        ):
            raise InvalidInputError(f"{where} has shape {array.shape}; it must be {self}")
        if not np.isfinite(array).all():
            index = ", ".join(str(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise InvalidInputError(f"{where}[{index}] is NaN or infinite; it must be finite")
        if (most := np.abs(array).max(initial=0.0)) > self.largest:
            raise InvalidInputError(
                f"{where} holds {most:.3g}, more than {self.largest:g}; give metres"
            )
        array.setflags(write=False)
        return array

    def write(self, value: FloatArray) -> list:
        """Nested lists."""
        return value.tolist()

    def __str__(self) -> str:
        return f"({', '.join('any' if n is None else str(n) for n in self.shape)}) {self.what}"

    def schema(self, of: Schema) -> dict[str, Any]:
        """Nested arrays of numbers."""
        inner: dict[str, Any] = {"type": "number"}
        for n in reversed(self.shape):
            inner = {"type": "array", "items": inner} | (
                {} if n is None else {"minItems": n, "maxItems": n}
            )
        return inner | {"description": self.what}


@dataclass(frozen=True)
class Tagged:
    """One of several dataclasses, chosen by a name in the json object with their fields."""

    key: str
    choices: Mapping[str, type]
    # replaced when a file that has them is read
    by_path: Mapping[str, type] = field(default_factory=dict)

    def read(self, value: Any, where: str) -> Any:
        """The dataclass that the name chooses."""
        if type(value) in self.choices.values():
            return value
        listed = ", ".join(self.choices)
        fields = dict(mapping(value, where, f"{self.key!r}, one of {listed}, and its fields"))
        if self.key not in fields:
            raise InvalidInputError(f"{at(where, self.key)} is missing; one of {listed}")
        name = fields.pop(self.key)
        if isinstance(name, str) and name in self.by_path:
            raise InvalidInputError(
                f"{at(where, self.key)} {name!r} names a file: load what names it from a file too"
            )
        if not isinstance(name, str) or name not in self.choices:
            raise UnknownChoiceError(at(where, self.key), name, (*self.choices, *self.by_path))
        return from_plain(self.choices[name], fields, where)

    def write(self, value: Any) -> dict[str, Any]:
        """Its name, then its fields."""
        name = next(name for name, kind in self.choices.items() if type(value) is kind)
        return {self.key: name, **to_plain(value)}

    def schema(self, of: Schema) -> dict[str, Any]:
        """One object for each choice."""
        choices = []
        for name, kind in (*self.choices.items(), *self.by_path.items()):
            plain = of(kind)
            properties = {self.key: {"const": name}, **plain["properties"]}
            choices.append(
                {**plain, "properties": properties, "required": [self.key, *plain["required"]]}
            )
        return {"oneOf": choices}


@dataclass(frozen=True)
class OneOrMore:
    """Several values of a kind; json may hold a single one without the list."""

    kind: Any

    def read(self, value: Any, where: str) -> tuple:
        """A tuple."""
        if isinstance(value, Mapping):
            return (from_plain(self.kind, value, where),)
        return from_plain(GenericAlias(tuple, (self.kind, ...)), value, where)

    def write(self, value: tuple) -> list:
        """A list."""
        return to_plain(value, GenericAlias(tuple, (self.kind, ...)))

    def schema(self, of: Schema) -> dict[str, Any]:
        """One, or an array."""
        one = of(self.kind)
        return {"anyOf": [one, {"type": "array", "items": one}]}


PRINTABLE, NAME_LENGTHS = "1 to 200 printable characters", {"minLength": 1, "maxLength": 200}
Name = Annotated[
    str, Condition(str, lambda s: 0 < len(s) <= 200 and s.isprintable(), PRINTABLE, NAME_LENGTHS)
]
UP_TO, ABOVE_0 = f"up to {LARGEST:g} [m]", {"exclusiveMinimum": 0, "maximum": LARGEST}
Length = Annotated[
    float, Condition(float, lambda x: 0.0 < x <= LARGEST, f"a positive length, {UP_TO}", ABOVE_0)
]
FROM_0 = {"minimum": 0, "maximum": LARGEST}
Padding = Annotated[
    float,
    Condition(float, lambda x: 0.0 <= x <= LARGEST, f"a length of 0 or more, {UP_TO}", FROM_0),
]

Angle = Annotated[
    float,
    Condition(
        float,
        lambda x: 0.0 <= x <= TURN,
        "from 0 to 2 pi [rad]: degrees? 10 degrees are 0.1745 rad",
        {"minimum": 0, "maximum": TURN},
    ),
]


def numbers(value: Any, where: str, what: str = "numbers") -> FloatArray:
    """Return a float copy of an array or of nested lists of numbers;
    refuse text, booleans and ragged lists.
    """
    try:
        if not isinstance(value, np.ndarray):
            entries = np.array(value, dtype=object).ravel()
            if any(isinstance(x, bool) or not isinstance(x, Real) for x in entries):
                raise TypeError
        return np.array(value, dtype=float) + 0.0  # + 0.0 turns -0.0 into 0.0: one form per value
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidInputError(f"{where} is {shown(value)}; it must be {what}") from error
