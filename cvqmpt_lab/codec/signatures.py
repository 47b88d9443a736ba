"""Signatures of dataclasses as `help` shows them:
types by their names, without the forms that read and write them.
"""

import inspect
import types
import typing
from typing import Any

import numpy as np


class _Text(str):
    """An annotation that is shown as it is."""

    __repr__ = str.__str__


class ReadableSignature:
    """`__signature__` of a dataclass and its subclasses."""

    def __get__(self, instance: Any, owner: Any) -> inspect.Signature:
        made = owner.__init__
        hints = made.__annotations__  # pydoc shows __init__ from these; fields keep theirs
        hints.update({name: _Text(readable(kind)) for name, kind in hints.items()})
        signature = inspect.signature(made)
        return signature.replace(parameters=list(signature.parameters.values())[1:])


def readable(kind: Any) -> str:
    """A type as text: "tuple[TaskSpaceRegion, ...]"."""
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        return readable(parts[0])
    if origin in (types.UnionType, typing.Union):
        return " | ".join(map(readable, parts))
    if origin is np.ndarray:
        return "ndarray"
    if origin is typing.Literal:
        return " | ".join(map(repr, parts))
    if kind is Ellipsis or isinstance(kind, str):
        return "..." if kind is Ellipsis else kind
    name = (
        "None" if kind in (None, types.NoneType) else getattr(origin or kind, "__name__", str(kind))
    )
    return f"{name}[{', '.join(map(readable, parts))}]" if parts else name
