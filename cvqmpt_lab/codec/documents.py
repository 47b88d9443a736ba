"""Values that are json files of their own, written so that people can read and change them."""

import json
from pathlib import Path
from typing import Any, ClassVar, Self

from cvqmpt_lab.codec.plain import Checked, field_kinds, from_plain, located, mapping, to_plain
from cvqmpt_lab.errors import InvalidInputError, shown
from cvqmpt_lab.files import read_json_object, write_text

EDITOR = "$schema"  # a field in which editors look for the json schema of a file; ignored
LINE = 120  # characters of json that still go on one line


class Document(Checked):
    """A value that is a json file of its own, which names the schema it follows."""

    SCHEMA: ClassVar[str]

    def to_dict(self) -> dict[str, Any]:
        """Plain json, the schema first."""
        return {"schema": self.SCHEMA, **to_plain(self)}

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """Inverse of `to_dict`; raises InvalidInputError with the path of the field that is wrong."""
        fields = dict(mapping(data, "", ", ".join(("schema", *field_kinds(cls)))))
        fields.pop(EDITOR, None)
        schema = fields.pop("schema", None)
        if schema != cls.SCHEMA:
            raise InvalidInputError(f"schema is {shown(schema)}; this version reads {cls.SCHEMA!r}")
        return from_plain(cls, fields)

    def save(self, path: Path | str) -> None:
        """Write json for people, whole or not at all."""
        write_text(Path(path), to_text(self.to_dict()) + "\n")

    @classmethod
    def load(cls, path: Path | str, **changes: Any) -> Self:
        """Read a file; errors name the file and the field. changes: fields to replace before, unless None."""
        data = read_json_object(Path(path))
        data |= {name: value for name, value in changes.items() if value is not None}
        with located(f"{path}"):
            return cls.from_dict(cls.with_named_files(data, Path(path).parent))

    @classmethod
    def with_named_files(cls, data: dict[str, Any], folder: Path) -> dict[str, Any]:
        """Json with what it names by path put in its place; folder: of the file it stands in."""
        return data


def to_text(plain: Any, indent: int = 0) -> str:
    """Json text: rows of numbers, matrices of poses, and whatever else fits, on one line."""
    flat = json.dumps(plain, allow_nan=False)
    if not isinstance(plain, dict | list) or len(flat) + indent <= LINE or _is_row(plain):
        return flat
    heads = [f"{json.dumps(key)}: " for key in plain] if isinstance(plain, dict) else [""] * len(plain)
    items = plain.values() if isinstance(plain, dict) else plain
    lines = [head + to_text(item, indent + 1) for head, item in zip(heads, items, strict=True)]
    brackets, pad = "{}" if isinstance(plain, dict) else "[]", "\n" + " " * (indent + 1)
    return brackets[0] + pad + f",{pad}".join(lines) + pad[:-1] + brackets[1]


def _is_row(plain: Any) -> bool:
    """Whether it is a list of numbers, or a small matrix."""
    if not isinstance(plain, list):
        return False
    rows = [item for item in plain if not isinstance(item, float | int | None)]
    small = all(isinstance(row, list) and _is_row(row) for row in rows) and sum(map(len, rows)) <= 16
    return not rows or (small and len(rows) == len(plain))
