"""Worker processes: end with the parent, memory, processor time, libraries on one thread."""

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

_ONE_THREAD_LOCK = threading.RLock()


def end_with_parent(parent: int, number: int = signal.SIGTERM) -> None:
    """End this process by signal `number` when its parent process ends (Linux only)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, number)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:  # the parent has ended already
            os._exit(1)


def limit_memory(most: int) -> None:
    """Limit this process's memory [bytes], and raise its score for being killed without memory."""
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")


def processor_time(pid: int) -> float:
    """Return the processor time [s] of a process and of all processes that it started (Linux).

    OSError: there is no such process.
    """
    place = Path(f"/proc/{pid}")
    # after the name in brackets, which may contain anything: time of its own, then of ended ones
    fields = (
        (place / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    )
    used = sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    with suppress(OSError):  # a thread or child ends meanwhile
        for thread in (place / "task").iterdir():
            for child in (thread / "children").read_text().split():
                used += processor_time(int(child))
    return used


@contextmanager
def one_thread() -> Iterator[None]:
    """Let BLAS and OpenMP use one thread: else rounding, and paths, depend on the number of cores.

    The limit holds for the whole process: another thread that enters this block waits.
    """
    with _ONE_THREAD_LOCK, _libraries(torch="torch" in sys.modules).limit(limits=1):
        yield


@lru_cache(maxsize=2)
def _libraries(*, torch: bool) -> ThreadpoolController:
    """Return the loaded libraries; they are searched again after torch, which loads more."""
    return ThreadpoolController()
