"""Json schemas of problem and task files, for editors:
from the annotations and comments of their fields.
"""

import ast
import dataclasses
import inspect
import textwrap
import typing
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from cvqmpt_lab.codec.plain import COMMENT, EDITOR, UNIONS, Document, field_defaults, field_kinds

FOLDER = Path(__file__).parents[1] / "schemas"  # of problem.schema.json and task.schema.json

SCALARS: Mapping[Any, dict[str, Any]] = {
    float: {"type": "number"},
    int: {"type": "integer", "minimum": 0},
    str: {"type": "string"},
    bool: {"type": "boolean"},
}


def schema_of(kind: type[Document]) -> dict[str, Any]:
    """The json schema (draft 2020-12) of files that `kind.load` reads."""
    builder = _Builder()
    plain = builder.of(kind)
    plain["properties"] = {
        "schema": {"const": kind.SCHEMA},
        EDITOR: {"type": "string"},
        **plain["properties"],
    }
    plain["required"] = ["schema", *plain["required"]]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": kind.SCHEMA,
        **plain,
        "$defs": builder.shared,
    }


class _Builder:
    """Schemas of types; a form with a title is defined once, in `shared`."""

    def __init__(self) -> None:
        self.shared: dict[str, Any] = {}

    def of(self, kind: Any) -> dict[str, Any]:
        """The schema of a type that `from_plain` reads."""
        origin, parts = typing.get_origin(kind), typing.get_args(kind)
        if origin is Annotated:
            return self._form(parts[1])
        if origin in UNIONS:
            return {"anyOf": [self.of(parts[0]), {"type": "null"}]}
        if origin is Literal:
            return {"enum": list(parts)}
        if origin is tuple and parts[-1] is Ellipsis:
            return {"type": "array", "items": self.of(parts[0])}
        if origin is tuple:
            items = [self.of(part) for part in parts]
            return {
                "type": "array",
                "prefixItems": items,
                "minItems": len(items),
                "maxItems": len(items),
            }
        if origin is Mapping:
            return {"type": "object"}
        return self._object(kind) if dataclasses.is_dataclass(kind) else dict(SCALARS[kind])

    def _form(self, form: Any) -> dict[str, Any]:
        title = getattr(form, "title", None)
        if title is None:
            return form.schema(self.of)
        if title not in self.shared:
            self.shared[title] = form.schema(self.of)
        return {"$ref": f"#/$defs/{title}"}

    def _object(self, kind: Any) -> dict[str, Any]:
        notes, kinds = _notes(kind), field_kinds(kind)
        properties = {
            name: {**self.of(part), "description": notes[name]} for name, part in kinds.items()
        }
        return {
            "type": "object",
            "description": inspect.getdoc(kind).split("\n")[0],  # type: ignore[union-attr]
            "properties": {**properties, COMMENT: {}},
            "required": [name for name in kinds if name not in field_defaults(kind)],
            "additionalProperties": False,
        }


def _notes(kind: type) -> dict[str, str]:
    """The comment or docstring of each field of a dataclass, bases included."""
    notes: dict[str, str] = {}
    for base in filter(dataclasses.is_dataclass, reversed(kind.__mro__)):
        source = textwrap.dedent(inspect.getsource(base))
        lines, body = source.splitlines(), ast.parse(source).body[0].body  # type: ignore[attr-defined]
        for field, below in pairwise([*body, None]):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                of_field = lines[field.lineno - 1 : field.end_lineno]
                note = next((line.partition("  # ")[2] for line in of_field if "  # " in line), "")
                match below:
                    case ast.Expr(value=ast.Constant(value=str(text))):
                        note = " ".join(text.split())
                notes[field.target.id] = note
    return notes
