"""Read frozen dataclasses from JSON and write them; annotations of fields define the format.

Annotations may be numbers, strings, booleans, `None`, `Literal`, tuples, mappings, dataclasses and
`Annotated[T, form]`. A form has a method `read(value, where)`, which makes a T from JSON or checks
a T, and may have `write(value)`, which returns JSON. Every object may have a field "_comment",
which is ignored. Errors begin with the path of the field. `json_schema` writes JSON schemas for
editors.
"""

import dataclasses
import hashlib
import inspect
import marshal
import operator
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias

import numpy as np

from cvqmpt_lab.base.errors import (
    CvqmptError,
    InvalidInputError,
    UnknownChoiceError,
    at,
    located,
    mapping,
    nearest,
    require_choice,
    shown,
)
from cvqmpt_lab.base.files import json_text, read_json_object, write_text
from cvqmpt_lab.base.values import scalar

Reader: TypeAlias = Callable[[Any, str], Any]
cached: Any = cache  # untyped: mypy refuses classes that define __hash__ as arguments of a cache


def from_plain(kind: Any, value: Any, where: str = "", complete: bool = False) -> Any:
    """Return a value of type `kind`, made from JSON or checked.

    Args:
        kind: a dataclass, a function (it is called with the fields) or another annotation.
        value: JSON, or a value of type `kind`.
        where: path of the value; errors begin with it.
        complete: whether fields with a default must be given, too.
    """
    return _reader(kind, complete)(value, where)


def to_plain(value: Any, kind: Any = None, complete: bool = False) -> Any:
    """Return the JSON of a value of type `kind` (None: its class); complete: with defaults."""
    kind = type(value) if kind is None else kind
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if value is None:
        return None
    if origin is Annotated:
        return parts[1].write(value) if hasattr(parts[1], "write") else to_plain(value)
    if origin in (types.UnionType, typing.Union):
        return to_plain(value, parts[0], complete)
    if origin is tuple:
        kinds = [parts[0]] * len(value) if parts[-1] is Ellipsis else parts
        return [to_plain(item, part, complete) for part, item in zip(kinds, value, strict=True)]
    if dataclasses.is_dataclass(value):
        plain = {}
        defaults = {} if complete else field_defaults(type(value))
        for name, part in field_kinds(type(value)).items():
            item = getattr(value, name)
            if name not in defaults or content_of(item) != content_of(defaults[name]):
                plain[name] = to_plain(item, part, complete)
        return plain
    return dict(value) if isinstance(value, Mapping) else value


class Checked:
    """Base of frozen dataclasses (eq=False) that are checked when made and compared by content."""

    def __post_init__(self) -> None:
        fields = vars(self)
        for name, read in _field_readers(type(self), False).items():
            try:
                fields[name] = read(fields[name], "")
            except CvqmptError:  # paths take time: they are made for errors only
                fields[name] = read(fields[name], at(self._shown_class(), name))
        self._check()

    def _shown_class(self) -> str:
        """Return the class, and the name if there is one, for messages."""
        name = vars(self).get("name")
        return type(self).__name__ + (f" {shown(name)}: " if isinstance(name, str) else "")

    def _check(self) -> None:
        """Refuse fields that contradict each other; each of them has been checked before."""

    def changed(self, **fields: Any) -> Self:
        """Return a copy with other values of some fields, which are not checked."""
        return _made(type(self), {**_fields(self), **fields})

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())

    def _content(self) -> Any:
        return content_of([*_fields(self).values()])


# what a JSON object without a schema is, by one of its fields
UNNAMED_KINDS: Mapping[str, str] = {
    "points": "a motion (cvqmpt certify MOTION PROBLEM judges it)",
    "states": "a path (cvqmpt certify PATH PROBLEM judges it)",
    "steps": "the list of a task's motions (cvqmpt certify FOLDER TASK judges them)",
    "urdf": "a robot (give it after --robot)",
    "objects": 'a scene (name it in a problem file, "scene": "FILE")',
}


class Document(Checked):
    """A value that is saved as a JSON file; its field "schema" names format and version."""

    SCHEMA: ClassVar[str]
    # what a file is by its schema, for messages
    KINDS: ClassVar[Mapping[str, str]] = {
        "cvqmpt-problem/1": "a problem file",
        "cvqmpt-task/1": "a task file",
    }

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object, the field "schema" first."""
        return {"schema": self.SCHEMA, **to_plain(self)}

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """Make a value from what `to_dict` returns; errors name the path of the wrong field."""
        fields = dict(mapping(data, "", ", ".join(("schema", *field_kinds(cls)))))
        fields.pop("$schema", None)  # for editors: the file of the JSON schema
        schema = fields.pop("schema", None)
        if schema != cls.SCHEMA:
            kind = cls.KINDS.get(schema if isinstance(schema, str) else "")
            if schema is None:
                kind = next((said for key, said in UNNAMED_KINDS.items() if key in fields), None)
            cure = f", {kind}" if kind else ""
            raise InvalidInputError(
                f"schema is {shown(schema)}{cure}; this version reads {cls.SCHEMA!r}"
            )
        return from_plain(cls, fields)

    def save(self, path: Path | str) -> None:
        """Write the value as an indented JSON file."""
        write_text(Path(path), json_text(self.to_dict()) + "\n")

    @classmethod
    def load(cls, path: Path | str, **changes: Any) -> Self:
        """Read a file; errors name file and field. changes: new values of fields; None: as read."""
        data = read_json_object(Path(path))
        data |= {name: value for name, value in changes.items() if value is not None}
        with located(f"{path}"):
            return cls.from_dict(cls.with_named_files(data, Path(path).parent))

    @classmethod
    def with_named_files(cls, data: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Return JSON in which named files (paths relative to `folder`) are replaced by content."""
        return data


@cached
def field_kinds(kind: Any) -> dict[str, Any]:
    """Return the annotation of each field of a dataclass, or argument of a function, by name."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {name: hints[name] for name in inspect.signature(kind).parameters}


@cached
def field_defaults(kind: Any) -> dict[str, Any]:
    """Return the default of each field, or argument, that has one, by name."""
    given = inspect.signature(kind).parameters.values()
    defaults = {item.name: item.default for item in given if item.default is not item.empty}
    for item in dataclasses.fields(kind) if isinstance(kind, type) else ():
        if item.default_factory is not dataclasses.MISSING:
            defaults[item.name] = item.default_factory()
    return defaults


# Forms of values.
@dataclass(frozen=True)
class Tagged:
    """Form of one of several dataclasses: a field of the JSON object names the class."""

    key: str  # name of that field
    choices: Mapping[str, type]
    # classes that name a file; `Document.with_named_files` replaces them when a file is read
    by_path: Mapping[str, type] = field(default_factory=dict)

    def read(self, value: Any, where: str) -> Any:
        """Return an instance of the class that the object names."""
        if type(value) in self.choices.values():
            return value
        listed = ", ".join(self.choices)
        fields = dict(mapping(value, where, f"{self.key!r}, one of {listed}, and its fields"))
        if self.key not in fields:
            raise InvalidInputError(f"{at(where, self.key)} is missing; one of {listed}")
        name = fields.pop(self.key)
        if isinstance(name, str) and name in self.by_path:
            raise InvalidInputError(
                f"{at(where, self.key)} {name!r} names a file: load the object that contains it "
                "from a file, too"
            )
        if not isinstance(name, str) or name not in self.choices:
            raise UnknownChoiceError(at(where, self.key), name, (*self.choices, *self.by_path))
        return _object(self.choices[name], False, fields, where)

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema of all classes, also of those that name a file."""
        classes = {**self.choices, **self.by_path}
        return {"oneOf": [schema_of(kind, {self.key: name}) for name, kind in classes.items()]}

    def write(self, value: Any) -> dict[str, Any]:
        """Return an object with the name of the class, then its fields."""
        name = next(name for name, kind in self.choices.items() if type(value) is kind)
        return {self.key: name, **to_plain(value)}


@dataclass(frozen=True)
class OneOrMore:
    """Form of a tuple of values of one kind; in JSON a list, or a single value without a list."""

    kind: Any

    def read(self, value: Any, where: str) -> tuple:
        """Return a tuple."""
        if isinstance(value, Mapping | str):
            return (from_plain(self.kind, value, where),)
        return _tuple((self.kind, ...), False)(value, where)

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema of both."""
        one = schema_of(self.kind)
        return {"anyOf": [one, {"type": "array", "items": one}]}

    def write(self, value: tuple) -> list:
        """Return a list."""
        return [to_plain(item, self.kind) for item in value]


# Reading.
def _reader(kind: Any, complete: bool) -> Reader:
    """Return the function that reads values of a type: (JSON, its path) -> value."""
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return parts[1].read
    if origin in (types.UnionType, typing.Union):  # a union is always `T | None`
        given = _reader(parts[0], complete)
        return lambda value, where: None if value is None else given(value, where)
    if origin is Literal:
        return lambda value, where: require_choice(where, value, parts)
    if origin is tuple:
        return _tuple(parts, complete)
    if origin is Mapping and dataclasses.is_dataclass(parts[1]):
        return partial(_named, _reader(parts[1], complete))
    if origin is Mapping:
        return lambda value, where: dict(mapping(value, where))
    if dataclasses.is_dataclass(kind) or inspect.isfunction(kind):
        return partial(_object, kind, complete)
    return partial(scalar, kind)


@cached
def _field_readers(kind: Any, complete: bool) -> dict[str, Reader]:
    return {name: _reader(part, complete) for name, part in field_kinds(kind).items()}


def _object(kind: Any, complete: bool, value: Any, where: str) -> Any:
    """Build a dataclass from a JSON object, or return an instance unchanged; or call a function."""
    if isinstance(kind, type) and isinstance(value, kind):
        return value
    readers = _field_readers(kind, complete)
    listed = ", ".join(readers)
    defaults = {} if complete else field_defaults(kind)
    for name in mapping(value, where, listed):
        if name not in readers and name != "_comment":
            unknown = f"{at(where, shown(name)[1:-1])} is unknown{nearest(name, readers)}"
            raise InvalidInputError(f"{unknown}; fields: {listed}")
    for name in readers:
        if name not in value and name not in defaults:
            raise InvalidInputError(f"{at(where, name)} is missing; fields: {listed}")
    parts = {
        name: read(value[name], at(where, name)) for name, read in readers.items() if name in value
    }
    with located(where):
        if not (isinstance(kind, type) and issubclass(kind, Checked)):
            return kind(**parts)
        made = _made(kind, {**defaults, **parts})
        made._check()
        return made


def _named(read: Reader, value: Any, where: str) -> dict[str, Any]:
    """Build the objects of a JSON object whose keys are names."""
    return {name: read(item, at(where, name)) for name, item in mapping(value, where).items()}


def _made(kind: Any, fields: dict[str, Any]) -> Any:
    """Return an instance of a frozen dataclass from checked fields, without another check."""
    made = object.__new__(kind)
    vars(made).update(fields)
    return made


def _tuple(parts: tuple[Any, ...], complete: bool) -> Reader:
    """Return the reader of a tuple; `parts` are its types, or (kind, ...) for any length."""
    each = [_reader(part, complete) for part in parts if part is not Ellipsis]
    any_length = parts[-1] is Ellipsis

    def read(value: Any, where: str) -> tuple:
        if not isinstance(value, list | tuple | np.ndarray):
            raise InvalidInputError(f"{where} is {shown(value)}; it must be a list, [...]")
        if not any_length and len(value) != len(each):
            raise InvalidInputError(f"{where} is {shown(value)}; it must be a list of {len(each)}")
        readers = each * len(value) if any_length else each
        try:
            return tuple([one(item, "") for one, item in zip(readers, value, strict=True)])
        except CvqmptError:  # paths take time: they are made for errors only
            return tuple(readers[k](item, f"{where}[{k}]") for k, item in enumerate(value))

    return read


# Comparing.
def _fields(value: Any) -> dict[str, Any]:
    return {name: getattr(value, name) for name in field_kinds(type(value))}


def digest_of(value: Checked) -> bytes:
    """Return the SHA-256 digest of the content of a value; its fields hold no mappings.

    The parts are numbers, texts, arrays, tuples and values whose parts are these.
    """
    made = hashlib.sha256()
    for part in _field_values(type(value))(value):
        items = part if type(part) is tuple else (part,)
        made.update(b"%d" % len(items))
        for item in items:  # one by one: a million objects at once would wake the garbage collector
            # version 2 of the format: without references, which depend on more than the content
            made.update(marshal.dumps(_plain_content(item), 2))
    return made.digest()


_PLAIN = frozenset((str, int, float, bool, type(None)))


def _plain_content(value: Any) -> Any:
    """Return the content of a value as tuples, numbers, texts and bytes."""
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind is np.ndarray:
        return content_of(value)
    if kind is tuple:
        return tuple([item if type(item) in _PLAIN else _plain_content(item) for item in value])
    return kind.__name__, _plain_content(_field_values(kind)(value))


@cached
def _field_values(kind: Any) -> Callable[[Any], tuple]:
    """Return the function that returns the fields of a dataclass as a tuple."""
    names = tuple(field_kinds(kind))
    get = operator.attrgetter(*names)
    return get if len(names) > 1 else lambda value: (get(value),)


def content_of(value: Any) -> Any:
    """Return a hashable value that is equal for equal contents."""
    if isinstance(value, np.ndarray):
        return value.shape if value.size else (), value.tobytes()
    if isinstance(value, Mapping):
        return tuple((name, content_of(part)) for name, part in value.items())
    return tuple(map(content_of, value)) if isinstance(value, tuple | list) else value
