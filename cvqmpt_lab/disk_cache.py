"""Cache on disk of arrays that take long to make;
the file's name is a hash of all that they depend on.
"""

import contextlib
import hashlib
import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import cache_folder, replacing, trusted_cache, written_by_owner_only

MOST = 256  # files of one kind; the oldest are deleted first


def sources_digest(*places: Path) -> str:
    """Hash of every source file in folders, or of single files, in hexadecimal."""
    digest = hashlib.sha256()
    for place in places:
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(str(path.relative_to(place.parent)).encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cached_arrays(
    kind: str,
    made_of: bytes,
    make: Callable[[], Mapping[str, np.ndarray]],
    fits: Callable[[Mapping[str, np.ndarray]], bool] = lambda arrays: True,
) -> dict[str, np.ndarray]:
    """What `make` returns, read from the cache if it is there.

    kind: folder of the cache. made_of: all that the arrays depend on, the sources that make them
        included.
    fits: whether arrays that were read can be what `make` returns; if not, they are made anew.
    """
    name = f"{hashlib.sha256(made_of).hexdigest()[:32]}.npz"
    with (
        contextlib.suppress(OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile),
        np.load(io.BytesIO(read_cached(kind, name)), allow_pickle=False) as found,
    ):
        read = dict(found)
        if fits(read):
            return read
    made: dict[str, Any] = dict(make())
    written = io.BytesIO()
    np.savez(written, **made)
    write_cached(kind, name, written.getvalue())
    return made


def read_cached(kind: str, name: str) -> bytes:
    """A file of the cache, in the folder `kind`;
    OSError if there is none that only the user could have written.
    """
    folder = trusted_cache(cache_folder() / kind)
    if folder is None:
        raise FileNotFoundError(name)
    return (folder / name).read_bytes()


def write_cached(kind: str, name: str, data: bytes) -> None:
    """Keep a file in the cache if there is a place for it;
    of more than MOST files the oldest are deleted.
    """
    folder = trusted_cache(cache_folder() / kind)
    if folder is None:
        return
    with contextlib.suppress(InvalidInputError):  # no writable cache: made again the next time
        with written_by_owner_only(), replacing(folder / name) as temporary:
            temporary.write_bytes(data)
        with contextlib.suppress(OSError):  # another process may delete them, too
            kept = sorted(folder.glob(f"*{Path(name).suffix}"), key=lambda p: p.stat().st_mtime_ns)
            for old in kept[:-MOST]:
                old.unlink()
