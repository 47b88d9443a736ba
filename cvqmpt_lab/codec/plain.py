"""Frozen dataclasses to json and back: the annotations of their fields say how they are read,
written and checked.

Understood are numbers, strings, booleans, `None`, `Literal`, tuples, mappings, dataclasses and
`Annotated[T, form]`. A form (see `forms`) has `read(value, where)`, which makes a T from json or
checks one; `write(value)`, its json; and `schema(of)`, its json schema, where `of` gives that of a
type. A field "_comment" is ignored in every object.
"""

import contextlib
import dataclasses
import json
import math
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np

from cvqmpt_lab.codec.signatures import ReadableSignature
from cvqmpt_lab.errors import CvqmptError, InvalidInputError, UnknownChoiceError, nearest, shown
from cvqmpt_lab.files import read_json_object, write_text

COMMENT = "_comment"
SCALARS: Mapping[Any, type] = {float: Real, int: Integral, str: str, bool: bool}
UNIONS = (types.UnionType, typing.Union)  # understood with None only


def from_plain(kind: Any, value: Any, where: str = "", complete: bool = False) -> Any:
    """Make a value of type `kind` from json, or check one; errors name, after `where`, the field
    that is wrong.

    complete: fields with a default must be given too.
    """
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return parts[1].read(value, where)
    if origin in UNIONS:
        return None if value is None else from_plain(parts[0], value, where, complete)
    if origin is Literal:
        if value not in parts:
            raise UnknownChoiceError(where, value, parts)
        return value
    if origin is tuple:
        kinds = enumerate(_tuple_kinds(parts, value, where))
        return tuple(from_plain(part, value[k], f"{where}[{k}]", complete) for k, part in kinds)
    if origin is Mapping:
        return dict(mapping(value, where))
    if dataclasses.is_dataclass(kind):
        return value if isinstance(value, kind) else _dataclass(kind, value, where, complete)  # type: ignore[arg-type]
    return _scalar(kind, value, where)


def to_plain(value: Any, kind: Any = None, complete: bool = False) -> Any:
    """Json of a value of type `kind` (its own);
    fields with their default value are left out unless complete.
    """
    kind = type(value) if kind is None else kind
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if value is None:
        return None
    if origin is Annotated:
        return parts[1].write(value)
    if origin in UNIONS:
        return to_plain(value, parts[0], complete)
    if origin is tuple:
        kinds = _tuple_kinds(parts, value, "")
        return [to_plain(item, part, complete) for part, item in zip(kinds, value, strict=True)]
    if dataclasses.is_dataclass(value):
        kind = type(value)
        defaults = {} if complete else field_defaults(kind)
        fields = {name: (getattr(value, name), part) for name, part in field_kinds(kind).items()}
        return {
            name: to_plain(part, kind, complete)
            for name, (part, kind) in fields.items()
            if name not in defaults or _content(part) != _content(defaults[name])
        }
    return dict(value) if isinstance(value, Mapping) else value


class Checked:
    """Base of frozen dataclasses (eq=False) that check their fields when made and are compared by
    content.
    """

    __signature__ = ReadableSignature()

    def __post_init__(self) -> None:
        name = getattr(self, "name", None)
        where = type(self).__name__ + (f" {shown(name)}: " if isinstance(name, str) else "")
        for field, kind in field_kinds(type(self)).items():
            object.__setattr__(
                self, field, from_plain(kind, getattr(self, field), at(where, field))
            )

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())

    def _content(self) -> Any:
        return _content([getattr(self, field) for field in field_kinds(type(self))])


def differences(recorded: object, asked: object, name: str = "") -> list[str]:
    """Describe every setting in which two json values differ, nested ones by dotted name."""
    if not (isinstance(recorded, dict) and isinstance(asked, dict)):
        return (
            []
            if recorded == asked
            else [f"{name} was {json.dumps(recorded)}, now {json.dumps(asked)}"]
        )
    found = []
    for key in sorted(recorded.keys() | asked.keys()):
        found += differences(recorded.get(key), asked.get(key), f"{name}.{key}" if name else key)
    return found


@contextlib.contextmanager
def located(where: str) -> Iterator[None]:
    """Put `where` in front of the message of an error raised inside."""
    try:
        yield
    except CvqmptError as error:
        if not where:
            raise
        kind = type(error) if isinstance(error, InvalidInputError) else InvalidInputError
        raise kind(f"{where}: {error}") from error


def unique(names: Iterable[str], where: str) -> None:
    """Refuse a name that occurs twice."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InvalidInputError(f"{where}: {shown(name)} occurs twice; names must be unique")
        seen.add(name)


def at(where: str, field: str) -> str:
    """The place of a field for errors, as `object.field`."""
    return f"{where}{'' if where.endswith(' ') or not where else '.'}{field}"


def mapping(value: Any, where: str, fields: str = "") -> Mapping[str, Any]:
    """Return a json object; refuse anything else, naming its fields."""
    if not isinstance(value, Mapping):
        must = f"an object with {fields}" if fields else "an object"
        raise InvalidInputError(f"{where or 'this'} is {shown(value)}; it must be {must}")
    return value


def field_kinds(kind: Any) -> dict[str, Any]:
    """The annotation of each field of a dataclass."""
    # mypy takes classes that define __hash__ for arguments no cache can have
    return _field_kinds(kind)


@cache
def _field_kinds(kind: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind) if field.init}


@cache
def field_defaults(kind: Any) -> dict[str, Any]:
    """The default of each field of a dataclass that has one."""
    given = {
        field.name: (field.default, field.default_factory) for field in dataclasses.fields(kind)
    }
    missing = dataclasses.MISSING
    return {
        name: default if make is missing else make()
        for name, (default, make) in given.items()
        if default is not missing or make is not missing
    }


def _dataclass(kind: Any, value: Any, where: str, complete: bool) -> Any:
    kinds = field_kinds(kind)
    listed, optional = ", ".join(kinds), {} if complete else field_defaults(kind)
    for name in mapping(value, where, listed):
        if name not in kinds and name != COMMENT:
            raise InvalidInputError(
                f"{at(where, shown(name)[1:-1])} is unknown{nearest(name, kinds)}; fields: {listed}"
            )
    for name in kinds:
        if name not in value and name not in optional:
            raise InvalidInputError(f"{at(where, name)} is missing; fields: {listed}")
    parts = {
        name: from_plain(part, value[name], at(where, name), complete)
        for name, part in kinds.items()
        if name in value
    }
    with located(where):
        return kind(**parts)


def _tuple_kinds(parts: tuple[Any, ...], value: Any, where: str) -> list[Any]:
    """The types of the items of a tuple of fixed length, or of any when `parts` is (kind, ...)."""
    if not isinstance(value, list | tuple | np.ndarray):
        raise InvalidInputError(f"{where} is {shown(value)}; it must be a list")
    kinds = [parts[0]] * len(value) if parts[-1] is Ellipsis else list(parts)
    if len(kinds) != len(value):
        raise InvalidInputError(f"{where} is {shown(value)}; it must be a list of {len(kinds)}")
    return kinds


def _scalar(kind: Any, value: Any, where: str) -> Any:
    if isinstance(value, SCALARS[kind]) and isinstance(value, bool) == (kind is bool):
        with contextlib.suppress(OverflowError):
            made = kind(value)
            if kind is int and made < 0:
                raise InvalidInputError(f"{where} is {shown(value)}; it cannot be negative")
            if kind is not float or math.isfinite(made):
                # + 0.0 turns -0.0 into 0.0: one form per value
                return made + 0.0 if kind is float else made
    must = "a finite float" if kind is float else kind.__name__
    raise InvalidInputError(f"{where} is {shown(value)}; it must be {must}")


def _content(value: Any) -> Any:
    """What is compared and hashed."""
    if isinstance(value, np.ndarray):
        return value.shape if value.size else (), value.tobytes()
    if isinstance(value, Mapping):
        return tuple((name, _content(part)) for name, part in value.items())
    return tuple(map(_content, value)) if isinstance(value, tuple | list) else value


# Json files: problems, tasks.
EDITOR = "$schema"  # field in which editors look for the json schema of a file; ignored
OPTIONS = {
    "cvqmpt-problem/1": "--problem-file",
    "cvqmpt-task/1": "--task-file",
}  # of `cvqmpt plan`, by schema
LINE = 120  # characters of json that go on one line


class Document(Checked):
    """A value that is saved as a json file, whose field "schema" names its format and version."""

    SCHEMA: ClassVar[str]

    def to_dict(self) -> dict[str, Any]:
        """Its json, the schema first."""
        return {"schema": self.SCHEMA, **to_plain(self)}

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """Inverse of `to_dict`; raises InvalidInputError with the path of the field that is wrong."""
        fields = dict(mapping(data, "", ", ".join(("schema", *field_kinds(cls)))))
        fields.pop(EDITOR, None)
        schema = fields.pop("schema", None)
        if schema != cls.SCHEMA:
            option = OPTIONS.get(schema if isinstance(schema, str) else "")
            cure = f": give it with {option}" if option else ""
            raise InvalidInputError(
                f"schema is {shown(schema)}{cure}; this version reads {cls.SCHEMA!r}"
            )
        return from_plain(cls, fields)

    def save(self, path: Path | str) -> None:
        """Write it as json that people can read."""
        write_text(Path(path), to_text(self.to_dict()) + "\n")

    @classmethod
    def load(cls, path: Path | str, **changes: Any) -> Self:
        """Read a file; errors name the file and the field. changes: fields to replace unless None."""
        data = read_json_object(Path(path))
        data |= {name: value for name, value in changes.items() if value is not None}
        with located(f"{path}"):
            return cls.from_dict(cls.with_named_files(data, Path(path).parent))

    @classmethod
    def with_named_files(cls, data: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Json in which files that it names, by paths relative to a folder, are read."""
        return data


def to_text(plain: Any, indent: int = 0) -> str:
    """Json text; rows of numbers, matrices of poses and what else fits stand on one line."""
    flat = json.dumps(plain, allow_nan=False)
    if not isinstance(plain, dict | list) or len(flat) + indent <= LINE or _is_row(plain):
        return flat
    heads = (
        [f"{json.dumps(key)}: " for key in plain] if isinstance(plain, dict) else [""] * len(plain)
    )
    items = plain.values() if isinstance(plain, dict) else plain
    lines = [head + to_text(item, indent + 1) for head, item in zip(heads, items, strict=True)]
    brackets, pad = "{}" if isinstance(plain, dict) else "[]", "\n" + " " * (indent + 1)
    return brackets[0] + pad + f",{pad}".join(lines) + pad[:-1] + brackets[1]


def _is_row(plain: Any) -> bool:
    """Whether it is a list of numbers, or a small matrix."""
    if not isinstance(plain, list):
        return False
    rows = [item for item in plain if not isinstance(item, float | int | None)]
    small = (
        all(isinstance(row, list) and _is_row(row) for row in rows) and sum(map(len, rows)) <= 16
    )
    return not rows or (small and len(rows) == len(plain))
