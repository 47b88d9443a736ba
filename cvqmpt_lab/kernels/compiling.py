"""How kernels are compiled: one decorator, `kernel`, with our options and a cache on disk.

Division is IEEE's, and a product and a sum may be fused into one instruction (a quarter of forward kinematics).

Machine code is cached in a folder named after the contents of all kernel sources, because numba alone does not
notice that a function called from another file has changed. NUMBA_CACHE_DIR chooses where that folder lies;
without a writable place everything still works, compiled anew in each process.
"""

import hashlib
import os
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

from numba import config, njit
from numba.core.caching import FunctionCache
from numba.core.runtime import rtsys

from cvqmpt_lab.files import cache_folder


def _sources_digest() -> str:
    """Hash of every file of this folder and those in it, in hexadecimal."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(str(path.relative_to(Path(__file__).parent)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


SOURCES = _sources_digest()


def _cache_folder() -> str | None:
    """A writable folder for machine code, or None with a warning."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or cache_folder()).expanduser() / SOURCES
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        warnings.warn(
            f"kernel cache {folder} is not writable ({error.strerror}): every process compiles for half a minute; "
            f"set NUMBA_CACHE_DIR to a writable folder",
            stacklevel=2,
        )
        return None
    return str(folder)


CACHE_FOLDER = _cache_folder()


class _Cache(FunctionCache):
    """Numba's cache on disk, which readies the compiler before it looks: half a second that only compiling needs."""

    def load_overload(self, sig, target_context):
        """The machine code of a signature, or None."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


INLINE: dict[str | None, dict] = {
    None: {},
    "machine": {"forceinline": True},
    "source": {"inline": "always"},
}


def kernel(
    function: Callable | None = None, *, inline: str | None = None, allocates: bool = False
) -> Callable:
    """Compile a function.

    Parameters
    ----------
    inline: "machine" merges its machine code into every caller: a bundle of arrays is passed as some hundred
        scalars, which a call in the hot path cannot afford. "source" pastes it into its callers before anything is
        compiled, which spares compiling it on its own.
    allocates: keep numba's reference counting, which arrays made inside need. It would cost more than the
        arithmetic of the hot path (residual and Jacobian of a region: 3.7 us with it, 0.7 us without).
    """
    if function is None:
        return partial(kernel, inline=inline, allocates=allocates)
    options = INLINE[inline] | ({} if allocates else {"_nrt": False})
    before = config.CACHE_DIR
    config.CACHE_DIR = CACHE_FOLDER or before
    try:
        compiled = njit(error_model="numpy", fastmath={"contract"}, no_cfunc_wrapper=True, **options)(
            function
        )
        if CACHE_FOLDER is not None:
            compiled._cache = _Cache(function)
        return compiled
    finally:
        config.CACHE_DIR = before


def compiled_before() -> bool:
    """Whether machine code of these sources is already on disk."""
    return CACHE_FOLDER is not None and any(Path(CACHE_FOLDER).rglob("*.nbc"))
