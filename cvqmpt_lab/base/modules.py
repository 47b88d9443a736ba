"""Modules of this package by the names of their files; import of modules of the user."""

import importlib
import sys
from collections.abc import Iterator, Mapping
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


class Modules(Mapping[str, Any]):
    """Modules of a folder by name, in order of the names; each is imported when it is used.

    The name of a module is that of its file without an ending, and with - in place of _.
    """

    def __init__(self, folder: str, ending: str = "") -> None:
        """Find the files `folder`/NAME`ending`.py of this package."""
        self._package = f"cvqmpt_lab.{folder.replace('/', '.')}"
        files = (Path(__file__).parents[1] / folder).glob(f"[!_]*{ending}.py")
        stems = sorted(path.stem for path in files)
        self._stems = {stem.removesuffix(ending).replace("_", "-"): stem for stem in stems}

    def __getitem__(self, name: str) -> Any:
        return importlib.import_module(f"{self._package}.{self._stems[name]}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._stems)

    def __len__(self) -> int:
        return len(self._stems)
