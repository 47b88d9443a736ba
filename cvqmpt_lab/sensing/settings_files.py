"""What a small json or yaml file says, as plain dicts, lists and numbers."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import json_value
from cvqmpt_lab.scene.files.reading import file_bytes, kind_of, parsing

LARGEST = 2**16  # [bytes]; calibrations take one thousand
FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


class _Loader(yaml.SafeLoader):
    """Plain values alone: no tags, no aliases (a few of which grow without end), no key twice."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise InvalidInputError("it has an alias (*name); write the value out")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict:
        keys = [self.construct_object(key) for key, _ in node.value]
        twice = next((key for k, key in enumerate(keys) if key in keys[:k]), None)
        if twice is not None:
            raise InvalidInputError(f"key {twice!r} occurs twice")
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", FLOAT, list("-+.0123456789"))  # 1e-3 is a number too


def read_settings(path: Path | str, what: str) -> Any:
    """Read a json or yaml file, by its suffix; `what` names it in errors.

    Raises
    ------
    UnknownChoiceError: another suffix.
    InvalidInputError: a file that cannot be read or parsed, or is no settings; names it.
    """
    path = Path(path)
    parse = PARSERS[kind_of(path, PARSERS, what)]
    data = file_bytes(path, what)
    with parsing(path, what):
        if len(data) > LARGEST:
            raise InvalidInputError(f"it has {len(data)} bytes; {LARGEST} at most")
        return parse(data.decode("utf-8"))


def _from_json(text: str) -> Any:
    return json_value(text, "it")


def _from_yaml(text: str) -> Any:
    return yaml.load(text, _Loader)  # a safe loader, see above


PARSERS: Mapping[str, Callable[[str], Any]] = {".json": _from_json, ".yaml": _from_yaml, ".yml": _from_yaml}
"""By suffix."""
