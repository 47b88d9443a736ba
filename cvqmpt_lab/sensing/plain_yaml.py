"""Yaml without what can do harm."""

import re
from typing import Any

import yaml

from cvqmpt_lab.errors import InvalidInputError

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


def plain_yaml(text: str) -> Any:
    """What a text says; InvalidInputError or yaml's own errors where it cannot be read."""
    return yaml.load(text, _Loader)  # a safe loader, see above
