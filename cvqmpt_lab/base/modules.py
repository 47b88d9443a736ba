"""Modules that are imported when they are needed: those of the user, and providers of parts.

A file alone never starts code: functions that it names, expressions of xacro and packages that it
names run only where `allow_code` was called before.

A file of a lower layer names a part, such as "world". `cvqmpt_lab/__init__.py` states which
files of higher layers provide it; they are imported when the part is first used.
"""

import importlib
import importlib.machinery
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, one_line


class Code:
    """Whether files may start code."""

    allowed: ClassVar[bool] = False


def allow_code() -> None:
    """Let files start code: functions that they name, xacro, and packages of robots ``rd:NAME``."""
    Code.allowed = True


def require_code_allowed(what: str, otherwise: str = "") -> None:
    """Refuse what would run code of a file where `allow_code` was not called.

    Args:
        what: the file and what it would run, as begin of the message.
        otherwise: what else cures it.
    """
    if not Code.allowed:
        raise InvalidInputError(
            f"{what}: add --allow-code if you trust the file (in Python: call allow_code())"
            f"{otherwise and '; or '}{otherwise}"
        )


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


def installed_module(distribution: str, module: str) -> Any:
    """Import a module of an installed distribution, never one of the working folder.

    Folders that can hold files of others, the working folder and that of the script, are not
    searched, neither for the module nor for modules that it imports.

    Raises:
        ModuleNotFoundError: the distribution is not installed, or has no such module.
    """
    places = _installed_places()
    found = next(iter(metadata.distributions(name=distribution, path=places)), None)
    if found is None:
        raise ModuleNotFoundError(f"no installed package {distribution}")
    top = sys.modules.get(module.partition(".")[0])
    with _search_path([str(found.locate_file("")), *places]):
        expected = importlib.machinery.PathFinder.find_spec(module.partition(".")[0], sys.path)
        loaded = getattr(top, "__spec__", None)
        if top and loaded and expected and loaded.origin != expected.origin:
            raise ModuleNotFoundError(f"{loaded.origin} was imported, no file of {distribution}")
        return importlib.import_module(module)


def _installed_places() -> list[str]:
    """Return the folders of `sys.path` without the working folder and the script's folder."""
    script = getattr(sys.modules.get("__main__"), "__file__", None)
    own = {Path.cwd(), *([Path(script).resolve().parent] if script else [])}
    full = [entry for entry in sys.path if Path(entry).is_absolute()]
    return [entry for entry in full if Path(entry).resolve() not in own]


@contextmanager
def _search_path(places: list[str]) -> Iterator[None]:
    """Search modules in these folders only during the block."""
    before = sys.path
    sys.path = places
    try:
        yield
    finally:
        sys.path = before


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
