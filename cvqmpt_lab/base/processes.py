"""Workers that end with their parent process, their memory, and numeric libraries on one thread."""

import ctypes
import os
import resource
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

from threadpoolctl import ThreadpoolController

_ONE_AT_A_TIME = threading.RLock()


def end_with_parent(parent: int, number: int = signal.SIGTERM) -> None:
    """End this process by a signal when `parent`, whose thread started it, ends (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, number)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:  # it has ended already
            os._exit(1)


def limit_memory(most: int) -> None:
    """Give this process at most so many bytes, and let it be killed first when memory runs out."""
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")


@contextmanager
def one_thread() -> Iterator[None]:
    """Let BLAS and OpenMP use one thread: else rounding, and paths, depend on the cores.

    The limit holds for the whole process: another thread that asks for it waits.
    """
    with _ONE_AT_A_TIME, _libraries(torch="torch" in sys.modules).limit(limits=1):
        yield


@lru_cache(maxsize=2)
def _libraries(*, torch: bool) -> ThreadpoolController:
    """The loaded libraries; searched again once torch is imported, as it brings its own."""
    return ThreadpoolController()
