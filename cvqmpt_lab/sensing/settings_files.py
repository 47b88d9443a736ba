"""What a small json or yaml file says, as plain dicts, lists and numbers."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import json_value
from cvqmpt_lab.scene.files.reading import file_bytes, kind_of, parsing

LARGEST = 2**16  # [bytes]; calibrations take one thousand


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
    from cvqmpt_lab.sensing.plain_yaml import plain_yaml  # imports yaml, which few commands need

    return plain_yaml(text)


PARSERS: Mapping[str, Callable[[str], Any]] = {".json": _from_json, ".yaml": _from_yaml, ".yml": _from_yaml}
"""By suffix."""
