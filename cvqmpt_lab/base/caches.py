"""Caches of slow results: the latest values in memory, arrays on disk.

A cache folder is used only if nobody but the user and root can change it.
"""

import contextlib
import hashlib
import os
import stat
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import numpy._core._multiarray_umath as umath

from cvqmpt_lab.base.errors import InvalidInputError, shown
from cvqmpt_lab.base.files import replacing
from cvqmpt_lab.base.readers import read_arrays

Made = TypeVar("Made")
_CACHE_WARNING = threading.Event()  # set after this process has warned about a cache folder
_UMASK_LOCK = threading.RLock()  # the umask belongs to the whole process


class LruCache(Generic[Made]):
    """Least-recently-used cache of at most `most` values."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._made = OrderedDict[Hashable, Made]()

    def get(self, key: Hashable, make: Callable[[], Made], use_cache: bool = True) -> Made:
        """Return the value of a key; it is made if it is not there or `use_cache` is False."""
        if not use_cache or key not in self._made:
            self._made[key] = make()
            if len(self._made) > self._most:
                self._made.popitem(last=False)
        self._made.move_to_end(key)
        return self._made[key]


def sources_digest(*places: Path) -> str:
    """Return a hash, in hexadecimal, of all source files in folders, or of single files."""
    digest = hashlib.sha256()
    for place in places:
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(str(path.relative_to(place.parent)).encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def numpy_instructions() -> list[str]:
    """Return the sets of instructions that numpy uses in this process, beside those it needs."""
    return [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__[name]]


def cached_arrays(
    kind: str,
    made_of: bytes,
    make: Callable[[], Mapping[str, np.ndarray]],
    fits: Callable[[Mapping[str, np.ndarray]], bool] = lambda arrays: True,
    most: int = 256,
) -> dict[str, np.ndarray]:
    """Return the arrays that `make` returns, read from the cache on disk if they are there.

    Args:
        kind: folder of the cache.
        made_of: all data that the arrays depend on, including the source code that makes them; the
            kernels of numpy are added here.
        make: function that computes the arrays, by name.
        fits: whether arrays from disk have the form of `make`'s; if not, they are computed again.
        most: largest number of files of one kind; the oldest are deleted first.
    """
    folder = trusted_cache(cache_folder() / kind)
    if folder is None:
        return dict(make())
    kernels = f"{numpy_instructions()} {os.environ.get('OPENBLAS_CORETYPE')}".encode()
    path = folder / f"{hashlib.sha256(kernels + made_of).hexdigest()[:32]}.npz"
    # a damaged archive can raise any exception; it has a checksum of each array
    with contextlib.suppress(Exception):
        read = read_arrays(path.read_bytes())
        if fits(read):
            return read
    made: dict[str, Any] = dict(make())
    with contextlib.suppress(InvalidInputError):  # no writable cache: computed again next time
        with written_by_owner_only(), replacing(path) as temporary, temporary.open("wb") as handle:
            np.savez(handle, **made)
        with contextlib.suppress(OSError):  # another process may delete them, too
            kept = sorted(folder.glob("*.npz"), key=lambda p: p.stat().st_mtime_ns)
            for old in kept[:-most]:
                old.unlink()
    return made


def cache_folder() -> Path:
    """Return the folder of this user's caches; it may not exist yet."""
    package = __name__.partition(".")[0]
    return named_folder("XDG_CACHE_HOME", "~/.cache") / package


def named_folder(variable: str, otherwise: str | Path) -> Path:
    """Return the full path of the folder in an environment variable, or `otherwise` if unset."""
    named = os.environ.get(variable) or otherwise
    try:
        return Path(named).expanduser().absolute()
    except (RuntimeError, OSError) as error:  # no such user, or the working folder was removed
        raise InvalidInputError(
            f"{variable}: no folder {shown(str(named))} ({error}); set it to the full path of a "
            "folder"
        ) from error


def trusted_cache(folder: Path) -> Path | None:
    """Return a cache folder that only the user and root can change, or None; it is made if needed.

    Machine code and pickles in a cache run with the user's rights. A folder that others could have
    changed, or an empty folder that cannot be written, is replaced by one in the temporary folder;
    a process warns once.
    """
    import tempfile  # imported here: most commands use no cache

    user = os.getuid() if hasattr(os, "getuid") else "user"
    faults = []
    for place in (folder, Path(tempfile.gettempdir(), f"cvqmpt_lab-{user}", folder.name)):
        try:
            with written_by_owner_only():
                place.mkdir(parents=True, exist_ok=True)
            place = place.resolve()  # no symbolic link remains that could be changed later
            fault = _exposed(place)
            if fault is None and not os.access(place, os.W_OK) and not any(place.iterdir()):
                fault = f"{place} is not writable"
        except OSError as error:
            fault = f"{place} is not writable ({error.strerror})"
        if fault is None:
            break
        faults.append(fault)
    if faults and not _CACHE_WARNING.is_set():
        _CACHE_WARNING.set()
        instead = (
            f"{place} is used" if len(faults) == 1 else f"{faults[1]}: everything is computed again"
        )
        cure = "set XDG_CACHE_HOME and NUMBA_CACHE_DIR to folders that only you can write"
        warnings.warn(f"cache: {faults[0]}; {instead}; {cure}", stacklevel=3)
    return place if len(faults) < 2 else None


def _exposed(place: Path) -> str | None:
    """Return why other users can change a folder or its files, or None; sticky parents are safe."""
    if not hasattr(os, "getuid"):
        return None  # Windows: the mode has no rights, and profiles belong to the user
    with os.scandir(place) as inside:
        paths = [*(item.path for item in inside), str(place), *map(str, place.parents)]
    for path in paths:
        try:
            found = os.lstat(path)
        except FileNotFoundError:  # another process has just replaced it
            continue
        if found.st_uid not in (0, os.getuid()):
            return f"{path} belongs to another user (id {found.st_uid})"
        sticky = found.st_mode & stat.S_ISVTX and path in map(str, place.parents)
        if stat.S_ISLNK(found.st_mode) or (found.st_mode & 0o022 and not sticky):
            return f"others can write {path} (chmod go-w cures that)"
    return None


@contextlib.contextmanager
def written_by_owner_only() -> Iterator[None]:
    """Make files and folders inside the block that group and others cannot write."""
    with _UMASK_LOCK:
        before = os.umask(0o022)
        os.umask(before | 0o022)
        try:
            yield
        finally:
            os.umask(before)
