"""Modules that are imported when they are needed: those of the user, and providers of parts.

A file of a lower layer names a part, such as "world". `cvqmpt_lab/__init__.py` states which
files of higher layers provide it; they are imported when the part is first used.
"""

import importlib
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, one_line


def described(error: BaseException) -> str:
    """Type and text of an error of the user's code, whose text may itself raise an error."""
    try:
        return one_line(f"{type(error).__name__}: {error}")
    except BaseException:
        return type(error).__name__


def imported(what: str, module: str) -> Any:
    """Import a module of the user; what: the noun with which errors begin."""
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
    try:
        return importlib.import_module(module)
    except CvqmptError:
        raise  # adapters say themselves what is not installed
    except ModuleNotFoundError as error:
        if error.name is not None and f"{module}.".startswith(f"{error.name}."):
            raise InvalidInputError(
                f"{what}: there is no module {error.name!r}; install it, or start in its folder"
            ) from error
        raise InvalidInputError(f"{what}: {module} needs {error.name!r}; install it") from error
    except BaseException as error:
        raise InvalidInputError(f"{what}: importing {module} raises {described(error)}") from error


_ADDRESSES: dict[str, tuple[str, ...]] = {}  # of providers, by part


def provide(addresses: Mapping[str, tuple[str, ...]]) -> None:
    """State who provides parts: addresses ``module`` or ``module:function`` by part."""
    _ADDRESSES.update(addresses)


@cache
def providers(part: str) -> tuple[Any, ...]:
    """Import and return the modules or functions that provide a part."""
    found = []
    for address in _ADDRESSES[part]:
        module, _, function = address.partition(":")
        loaded = importlib.import_module(module)
        found.append(getattr(loaded, function) if function else loaded)
    return tuple(found)


def provider(part: str) -> Any:
    """Import and return the only provider of a part."""
    (only,) = providers(part)
    return only
