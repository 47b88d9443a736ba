"""Machine code of entries: read from disk, where numba is not needed, or built by it and kept there.

The entries of a group of modules are one object file, so that what they share, projection and state checks above
all, is compiled once. Files lie in a folder named after the contents of all kernel sources; their names hold a digest
of what else machine code depends on. NUMBA_CACHE_DIR chooses where that folder lies; without a writable place
everything still works, compiled anew in each process.
"""

import contextlib
import functools
import hashlib
import os
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.disk_cache import sources_digest
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import cache_folder, write_bytes
from cvqmpt_lab.kernels.annotations import Compilable
from cvqmpt_lab.kernels.loading import loaded

GROUPS: dict[str, tuple[str, ...]] = {
    "poses": ("manifold.kinematics",),
    "robot": ("collision.sphere_cover",),
    "plan": (
        "manifold.projection", "manifold.regions", "collision.distance_grid", "collision.grid_filling",
        "search.reach", "search.single_state", "search.motion", "search.space_arrays", "search.tree_growth",
        "search.shortcut",
    ),
    "roadmap": ("search.sight", "search.lazy_roadmap", "search.code_graph"),
    "labels": ("search.edge_verdicts",),
}  # fmt: skip
"""What is compiled together, by modules of this room."""

ROOM = __package__ + "."
GROUP_OF = {ROOM + module: group for group, modules in GROUPS.items() for module in modules}
_DIGEST = 32  # bytes at the head of a file
VERSIONS = 8
"""Of the kernel sources, whose machine code is kept; the folder of one is touched by every process that uses it."""


SOURCES = sources_digest(Path(__file__).parent)
"""Of all kernels."""


@functools.cache
def folder() -> Path | None:
    """A writable folder for machine code, or None with a warning."""
    place = Path(os.environ.get("NUMBA_CACHE_DIR") or cache_folder()).expanduser() / SOURCES
    try:
        place.mkdir(parents=True, exist_ok=True)
        probe = place / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        warnings.warn(
            f"kernel cache {place} is not writable ({error.strerror}): every process compiles for half a minute; "
            f"set NUMBA_CACHE_DIR to a writable folder",
            stacklevel=2,
        )
        return None
    return place


def compiled_before(groups: Sequence[str] = ("plan",)) -> bool:
    """Whether machine code of groups is already on disk."""
    return folder() is not None and all(_path(group).is_file() for group in groups)


def make_ready(groups: Sequence[str] = tuple(GROUPS)) -> None:
    """Load groups, compiled first where they were not before."""
    for group in groups:
        _functions(group)


def function(entry: Compilable) -> Callable[[tuple], Any]:
    """An entry as a function of its arguments in a tuple, from the object file of its group."""
    group = GROUP_OF.get(entry.__module__)
    return (
        _functions(group)[entry.symbol] if group else loaded(_built((entry,)), (entry.symbol,))[entry.symbol]
    )


@functools.cache
def _functions(group: str) -> dict[str, Callable[[tuple], Any]]:
    """Symbols of a group, and what they call."""
    entries = _entries(group)
    symbols = tuple(entry.symbol for entry in entries)
    if folder() is None:
        return loaded(_built(entries), symbols)
    path = _path(group)
    with contextlib.suppress(OSError):
        data = path.read_bytes()
        if hashlib.sha256(data[_DIGEST:]).digest() == data[:_DIGEST]:
            return loaded(data[_DIGEST:], symbols)
    code = _built(entries)
    with contextlib.suppress(InvalidInputError):  # a full disk: compiled anew the next time
        write_bytes(path, hashlib.sha256(code).digest() + code)
        forget_unused(path.parent.parent)
    return loaded(code, symbols)


def forget_unused(place: Path, kept: int = VERSIONS) -> None:
    """Remove machine code of all but the versions of the sources that were used last."""
    with contextlib.suppress(OSError):  # another process removes it, too
        found = [one for one in place.iterdir() if re.fullmatch("[0-9a-f]{16}", one.name) and one.is_dir()]
        ours = [one for one in found if all(file.suffix == ".o" for file in one.iterdir())]
        for old in sorted(ours, key=lambda one: one.stat().st_mtime_ns)[:-kept]:
            shutil.rmtree(old)


def _entries(group: str) -> tuple[Compilable, ...]:
    """Entries of the modules of a group."""
    modules = [import_module(ROOM + name) for name in GROUPS[group]]
    return tuple(
        value
        for module in modules
        for value in vars(module).values()
        if hasattr(value, "symbol") and value.__module__ == module.__name__
    )


def _path(group: str) -> Path:
    place = folder()
    assert place is not None
    return place / f"{group}-{_machine()}.o"


def _built(entries: tuple[Compilable, ...]) -> bytes:
    from cvqmpt_lab.kernels.building import build  # imports numba

    return build(entries)


@functools.cache
def _machine() -> str:
    """A digest of what machine code depends on besides its sources."""
    import llvmlite.binding as llvm

    parts = [version("numba"), version("llvmlite"), np.__version__, sys.version]
    parts += (llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
