"""Names of external planners: addresses ``module:planner``, and entry points of distributions.

The process of a planner is in `external.door`, which is imported when one is used.
"""

from collections.abc import Collection
from functools import lru_cache
from importlib import metadata

from cvqmpt_lab.base.errors import InvalidInputError

ENTRY_POINT_GROUP = "cvqmpt.planners"


def is_external(name: str) -> bool:
    """Return whether the name has the form ``module:planner`` or names an entry point."""
    return ":" in name or name in entry_point_names()


def entry_point_names() -> list[str]:
    """Return the names of the external planners that installed distributions declare."""
    return sorted({entry.name for entry in entry_points()})


def refuse_clash(name: str, own: Collection[str]) -> None:
    """Refuse a name that is in `own`, the planners of this package, and an entry point too."""
    for entry in entry_points():
        if entry.name == name and name in own:
            raise InvalidInputError(
                f"planner {name!r} of {distribution_of(entry)} has the name of one of ours: rename "
                f"it in its entry points {ENTRY_POINT_GROUP}, or give its address {entry.value}"
            )


@lru_cache(maxsize=1)
def entry_points() -> tuple[metadata.EntryPoint, ...]:
    """Return the entry points of external planners, each once."""
    found = metadata.entry_points(group=ENTRY_POINT_GROUP)
    return tuple({(entry.name, entry.value): entry for entry in found}.values())


def distribution_of(entry: metadata.EntryPoint) -> str:
    """Return name and version of the distribution that declares an entry point."""
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown distribution"
