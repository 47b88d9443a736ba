"""Planners of others by name: ``package.module:planner``, an entry point of a distribution, or an
adapter that ships.

A planner is a function (problem, budget, seed) -> path, or a class without arguments whose
instances are called so; see `external.call` for what it may return.
"""

import importlib
import importlib.util
import sys
from collections.abc import Callable, Collection
from functools import lru_cache
from importlib import metadata
from inspect import isclass
from pathlib import Path
from typing import Any, NamedTuple

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError, install_command, shown

GROUP = "cvqmpt.planners"  # of entry points


class Peer(NamedTuple):
    """An adapter that ships:
    its module, whose planner is called `plan`, and the distributions that it needs.
    """

    module: str
    needs: dict[str, str]  # distribution by the name under which it is imported


PEERS = {
    "roboplan": Peer("cvqmpt_lab.external.roboplan_peer", {"roboplan": "roboplan"}),
    "sscbirrt": Peer(
        "cvqmpt_lab.external.sscbirrt_peer",
        {"sscbirrt": "sscbirrt", "mujoco": "mujoco", "ssik": "ssik"},
    ),
    "hpp": Peer("cvqmpt_lab.external.hpp_peer", {"pyhpp": "hpp-python"}),
}


class Found(NamedTuple):
    """A planner of others."""

    planner: Callable[..., Any]
    made_by: str  # distributions and their versions, or the module's file


@lru_cache(maxsize=32)
def find_external(name: str) -> Found:
    """The planner of that name, made once a process.

    InvalidInputError: there is none, it cannot be imported or called, or several distributions have
    one.
    """
    if name in PEERS:
        return _peer(name, PEERS[name])
    if ":" in name:
        module, _, attribute = name.partition(":")
        return Found(_made(name, _attribute(name, module, attribute)), _made_by(module))
    entries = [entry for entry in _entry_points() if entry.name == name]
    if len(entries) != 1:
        who = ", ".join(_distribution(entry) for entry in entries)
        raise InvalidInputError(
            f"planner {name!r} is of {len(entries)} distributions, {who}: keep one of them"
        )
    module, _, attribute = entries[0].value.partition(":")
    return Found(_made(name, _attribute(name, module, attribute)), _distribution(entries[0]))


def external_names() -> list[str]:
    """Names of entry points."""
    return sorted({entry.name for entry in _entry_points()})


def refuse_clash(name: str, ours: Collection[str]) -> None:
    """InvalidInputError if the name is one of ours and an installed distribution has a planner of
    that name, too.
    """
    for entry in _entry_points():
        if entry.name == name and name in ours:
            raise InvalidInputError(
                f"planner {name!r} of {_distribution(entry)} has the name of one of ours: rename "
                f"it in its entry "
                f"points {GROUP}, or call it {entry.value}"
            )


@lru_cache(maxsize=1)
def _entry_points() -> tuple[metadata.EntryPoint, ...]:
    unique = {(entry.name, entry.value): entry for entry in metadata.entry_points(group=GROUP)}
    return tuple(unique.values())


def _distribution(entry: metadata.EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown distribution"


def _peer(name: str, peer: Peer) -> Found:
    missing = [
        wanted for module, wanted in peer.needs.items() if importlib.util.find_spec(module) is None
    ]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise InvalidInputError(
            f"planner {name} needs {' and '.join(missing)}, which {verb} not installed: "
            f"{install_command('peers')}"
        )
    versions = [f"{wanted} {metadata.version(wanted)}" for wanted in peer.needs.values()]
    return Found(_attribute(name, peer.module, "plan"), ", ".join(versions))


def _attribute(name: str, module: str, attribute: str) -> Any:
    """What a module calls so;
    modules of the folder from which the command was started are found, too.
    """
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and (module == error.name or module.startswith(f"{error.name}.")):
            raise InvalidInputError(
                f"planner {name}: there is no module {error.name!r}; install it, or start in its "
                f"folder"
            ) from error
        raise InvalidInputError(
            f"planner {name}: {module} needs {error.name!r}; install it"
        ) from error
    except Exception as error:
        raise InvalidInputError(
            f"planner {name}: importing {module} raises {_said(error)}"
        ) from error
    if not hasattr(loaded, attribute):
        choices = [
            key
            for key, value in vars(loaded).items()
            if callable(value) and not key.startswith("_")
        ]
        raise UnknownChoiceError(f"planner of {module}", attribute, choices)
    return getattr(loaded, attribute)


def _made(name: str, planner: Any) -> Callable[..., Any]:
    """The planner itself, of a class its one instance."""
    if isclass(planner):
        try:
            planner = planner()
        except Exception as error:
            raise InvalidInputError(
                f"planner {name}: making it without arguments raises {_said(error)}"
            ) from error
    if not callable(planner):
        raise InvalidInputError(
            f"planner {name} is {shown(planner)}: give a function (problem, budget, seed), or a "
            f"class of such"
        )
    return planner


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _made_by(module: str) -> str:
    """Distribution and version of a module; the digest of its file where it is of no distribution."""
    top = module.partition(".")[0]
    owners = sorted(set(metadata.packages_distributions().get(top, ())))
    if owners:
        return ", ".join(f"{owner} {metadata.version(owner)}" for owner in owners)
    from hashlib import sha256

    path = Path(sys.modules[module].__file__ or "")
    return (
        f"{path.name} sha256 {sha256(path.read_bytes()).hexdigest()[:16]}"
        if path.is_file()
        else module
    )
