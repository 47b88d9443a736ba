"""JSON schemas of the files that `codec` reads, for editors.

They follow from the annotations of fields. A form has a method `schema(schema_of)`, where
`schema_of` returns the schema of another annotation. Descriptions are the comments beside or above
the fields of a class, and the lines of `Args:` of a function. Classes, and forms whose class is
called `...Form`, stand once, in `$defs`.
"""

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from cvqmpt_lab.base.codec import Document, field_defaults, field_kinds

Schema = dict[str, Any]
SCALARS: Mapping[Any, Schema] = {
    str: {"type": "string"},
    bool: {"type": "boolean"},
    int: {"type": "integer", "minimum": 0},
    float: {"type": "number"},
}


def json_schema(document: type[Document]) -> Schema:
    """Return the JSON schema of the files of a class."""
    schemas = _Schemas()
    names = {"$schema": {"type": "string"}}
    found = schemas.object(document, {"schema": document.SCHEMA}, **names)
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return {**dialect, "title": document.SCHEMA, **found, "$defs": schemas.shared}


class _Schemas:
    """Schemas of annotations; those that may repeat are collected in `shared`."""

    def __init__(self) -> None:
        self.shared: dict[str, Schema] = {}

    def __call__(self, kind: Any, constants: Mapping[str, str] | None = None) -> Schema:
        """Return the schema of an annotation; constants: fields with one value, by name."""
        origin, parts = typing.get_origin(kind), typing.get_args(kind)
        if origin is Annotated:
            return self._of_form(*parts[:2])
        if origin in (types.UnionType, typing.Union):
            return {"anyOf": [self(part) for part in parts]}
        if origin is Literal:
            return {"enum": [*parts]}
        if origin is tuple:
            if parts[-1] is Ellipsis:
                return {"type": "array", "items": self(parts[0])}
            length = {"minItems": len(parts), "maxItems": len(parts)}
            return {"type": "array", "prefixItems": [self(part) for part in parts], **length}
        if origin is Mapping:
            return {"type": "object", "additionalProperties": self(parts[1])}
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            return self._share(kind.__name__, lambda: self.object(kind, constants or {}))
        if inspect.isfunction(kind):
            return self.object(kind, {})
        return {"type": "null"} if kind is type(None) else dict(SCALARS.get(kind, {}))

    def object(self, kind: Any, constants: Mapping[str, str], **others: Any) -> Schema:
        """Return the schema of a class or function.

        Args:
            kind: the class or function.
            constants: fields with one value, by name.
            others: schemas or annotations of further fields, by name.
        """
        fields, defaults = field_kinds(kind), field_defaults(kind)
        words = _descriptions(kind)
        properties: dict[str, Any] = {name: {"const": value} for name, value in constants.items()}
        for name, part in others.items():
            properties[name] = part if isinstance(part, dict) else self(part)
        for name, part in fields.items():
            properties[name] = self(part)
            if name in words:
                properties[name] = {**properties[name], "description": words[name]}
            if isinstance(default := defaults.get(name), int | float | str) and default != "":
                properties[name] = {**properties[name], "default": default}
        return {
            "type": "object",
            "description": _plain((inspect.getdoc(kind) or "").partition("\n")[0]),
            "properties": {**properties, "_comment": {}},
            "required": [*constants, *(name for name in fields if name not in defaults)],
            "additionalProperties": False,
        }

    def _of_form(self, kind: Any, form: Any) -> Schema:
        name = type(form).__name__
        if not hasattr(form, "schema"):
            return self(kind)
        if not name.endswith("Form"):
            return form.schema(self)
        name = name.removesuffix("Form").lower() + getattr(form, "variant", "")
        return self._share(name, lambda: form.schema(self))

    def _share(self, name: str, make: Callable[[], Schema]) -> Schema:
        if name not in self.shared:
            self.shared[name] = {}  # holds the place
            self.shared[name] = make()
        return {"$ref": f"#/$defs/{name}"}


def _plain(text: str) -> str:
    """Return a description as readers of JSON need it."""
    text = re.sub(r"\bNone\b", "null", " ".join(text.split()).removeprefix("Return "))
    return text[:1].upper() + text[1:]


def _descriptions(kind: Any) -> dict[str, str]:
    """Return the description of each field of a class, or argument of a function, that has one."""
    if inspect.isfunction(kind):
        arguments = (inspect.getdoc(kind) or "").partition("Args:\n")[2]
        found = re.findall(r"^    (\w+): (.*?)(?=^    \w+: |^\S|\Z)", arguments, re.M | re.S)
        return {name: _plain(text) for name, text in found}
    described: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            described |= _comments(base)
    return described


def _comments(kind: Any) -> dict[str, str]:
    """Return the comment beside, above or below each field of a class in its source."""
    text = Path(inspect.getfile(kind)).read_text(encoding="utf-8")
    start = re.search(rf"^class {kind.__name__}\b.*\n", text, re.MULTILINE)
    described: dict[str, str] = {}
    above: list[str] = []
    last = ""
    for line in text[start.end() :].splitlines() if start else ():
        bare = line.strip()
        if bare and not line.startswith(" "):
            break
        if bare.startswith("# "):
            above.append(bare[2:])
            continue
        field = re.match(r"    (\w+):(?: |$)", line)
        if field:
            last = field[1]
            described[last] = _plain(" ".join([*above, line.partition("  # ")[2]]))
        elif last and bare.startswith('"""') and not described[last]:
            described[last] = _plain(bare.strip('"'))
        above = []
    return {name: words for name, words in described.items() if words}
