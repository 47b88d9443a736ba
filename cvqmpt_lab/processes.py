"""Processes that do not outlive the one they work for, however that ends."""

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from threadpoolctl import ThreadpoolController

PR_SET_PDEATHSIG = 1


def end_with_parent(parent: int) -> None:
    """Let this process end when `parent`, which started it, ends; at once if that has happened (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:  # it ended before this was asked for
            os._exit(1)


# How many threads the numeric libraries use.
@contextmanager
def one_thread() -> Iterator[None]:
    """Let BLAS and OpenMP use one thread meanwhile.

    How a product is split among threads decides how its sums are rounded, so paths of learned methods would depend
    on the number of cores; and the products of one plan are too small to gain from more.
    """
    with _libraries(torch="torch" in sys.modules).limit(limits=1):
        yield


@lru_cache(maxsize=2)
def _libraries(*, torch: bool) -> ThreadpoolController:
    """The libraries that are loaded; torch brings some of its own, and they are looked for anew once it is there."""
    return ThreadpoolController()
