"""Cache on disk of arrays that take long to make; the file's name is a hash of all that they depend on."""

import contextlib
import hashlib
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import cache_folder, make_folder, replacing

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
    kind: str, made_of: bytes, make: Callable[[], Mapping[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """What `make` returns, read from the cache if it is there.

    kind: folder of the cache. made_of: all that the arrays depend on, the sources that make them included.
    """
    path = cache_folder() / kind / f"{hashlib.sha256(made_of).hexdigest()[:32]}.npz"
    with (
        contextlib.suppress(OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile),
        np.load(path) as found,
    ):
        return dict(found)
    made: dict[str, Any] = dict(make())
    with contextlib.suppress(InvalidInputError):  # no writable cache: made again the next time
        make_folder(path.parent)
        with replacing(path) as temporary, temporary.open("wb") as handle:
            np.savez(handle, **made)
        with contextlib.suppress(OSError):  # another process may delete them, too
            for old in sorted(path.parent.glob("*.npz"), key=lambda p: p.stat().st_mtime_ns)[:-MOST]:
                old.unlink()
    return made
