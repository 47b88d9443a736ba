"""Yaml of others:
plain values only, no tags, no aliases (a few of which grow without end), no key twice.
"""

import re
from typing import Any

from cvqmpt_lab.errors import InvalidInputError

FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


def yaml_value(text: str) -> Any:
    """Dicts, lists, text and numbers; yaml's own errors for what is no yaml."""
    import yaml  # planning without such files need not pay for it

    class Loader(yaml.SafeLoader):
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

    # 1e-3 too
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", FLOAT, list("-+.0123456789"))
    return yaml.load(text, Loader)
