"""Frozen dataclasses of plain values to json and back, every wrong field named."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError


def to_plain(value: Any) -> dict[str, Any]:
    """A dataclass as dictionaries, lists, numbers and strings, as json would give them back."""
    return _plain(dataclasses.asdict(value))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    return [_plain(part) for part in value] if isinstance(value, tuple) else value


def from_plain(kind: Any, value: Any, where: str) -> Any:
    """Make a dataclass, tuple, number, string or choice of type `kind` from json.

    Raises
    ------
    InvalidInputError, UnknownChoiceError
        Naming, after `where`, the field that is unknown, missing or of the wrong type.
    """
    if isinstance(kind, types.UnionType):
        options = [option for option in typing.get_args(kind) if option is not type(None)]
        return None if value is None else from_plain(options[0], value, where)
    if typing.get_origin(kind) is Literal:
        if value not in typing.get_args(kind):
            raise UnknownChoiceError(where, value, typing.get_args(kind))
        return value
    if typing.get_origin(kind) is tuple:
        return _tuple(typing.get_args(kind), value, where)
    if dataclasses.is_dataclass(kind):
        return _dataclass(kind, value, where)
    accepted = (int, float) if kind is float else (kind,)
    if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
        raise InvalidInputError(f"{where} is {value!r}; it must be {kind.__name__}")
    if kind is int and value < 0:
        raise InvalidInputError(f"{where} is {value}; it cannot be negative")
    return kind(value)


def _tuple(parts: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    """Make a tuple of fixed length, or of any length when `parts` is (kind, ...)."""
    if not isinstance(value, list):
        raise InvalidInputError(f"{where} is {value!r}; it must be a list")
    kinds = [parts[0]] * len(value) if parts[-1] is Ellipsis else list(parts)
    if len(kinds) != len(value):
        raise InvalidInputError(f"{where} is {value!r}; it must be a list of {len(kinds)}")
    return tuple(from_plain(kind, part, where) for kind, part in zip(kinds, value, strict=True))


def _dataclass(kind: Any, value: Any, where: str) -> Any:
    hints = typing.get_type_hints(kind)
    if not isinstance(value, Mapping):
        raise InvalidInputError(f"{where} is {value!r}; it must be an object with {', '.join(hints)}")
    for name in (*value, *hints):
        if name not in hints or name not in value:
            state = "unknown" if name not in hints else "missing"
            raise InvalidInputError(f"{where}.{name} is {state}; fields: {', '.join(hints)}")
    return kind(**{name: from_plain(hints[name], value[name], f"{where}.{name}") for name in hints})
