"""Executors of an experiment's runs: processes on this machine, by pebble, or a Dask cluster.

A cluster is `dask scheduler` on one machine and `dask worker --nthreads 1` on many.
"""

import faulthandler
import multiprocessing
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

from cvqmpt_lab.base.errors import (
    CvqmptError,
    InvalidInputError,
    require_installed,
    whole_number,
)
from cvqmpt_lab.base.processes import end_with_parent, limit_memory
from cvqmpt_lab.results.row import FailReason

CONNECT_S = 10  # for a scheduler to answer [s]
STOPPED = (
    "the executor of the runs has stopped; what was finished is kept, the same command continues"
)
Task = TypeVar("Task")


class Lost(NamedTuple):
    """Reason why a task has no result: its process ended, hung or ran out of memory."""

    reason: FailReason
    detail: str


@dataclass(frozen=True)
class Executor:
    """Executor that applies a function to many tasks in parallel."""

    size: int  # tasks at a time
    submit: Callable[..., Future]  # a function and its arguments
    # errors that cost one task; any other one is raised
    losses: Mapping[type[BaseException], FailReason]
    attempts: int = 1  # at a task whose process ends: something else may have ended it

    def results(
        self, function: Callable[[Task], Any], tasks: Iterable[Task]
    ) -> Iterator[tuple[Task, Any]]:
        """Yield every task with its result or `Lost` when it is finished; few tasks are queued."""
        waiting = deque((task, 1) for task in tasks)
        running: dict[Future, tuple[Task, int]] = {}
        while waiting or running:
            while waiting and len(running) < 2 * self.size:
                task, attempt = waiting.popleft()
                try:
                    running[self.submit(function, task)] = task, attempt
                # exceptions of pebble and Dask for an executor that has stopped
                except RuntimeError as error:
                    raise CvqmptError(STOPPED) from error
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                task, attempt = running.pop(future)
                result = self._result(future)
                died = isinstance(result, Lost) and result.reason is FailReason.WORKER_DIED
                if died and attempt < self.attempts:
                    waiting.appendleft((task, attempt + 1))
                else:
                    yield task, result

    def _result(self, future: Future) -> Any:
        try:
            return future.result()
        except tuple(self.losses) as error:
            reason = next(reason for kind, reason in self.losses.items() if isinstance(error, kind))
            return Lost(reason, _detail(error))
        except (CancelledError, BrokenProcessPool) as error:
            raise CvqmptError(STOPPED) from error


def _detail(error: BaseException) -> str:
    """Return the text for the row of a lost task."""
    code = getattr(error, "exitcode", None)  # of pebble.ProcessExpired
    if code is not None and code < 0:
        cause = "; perhaps memory ran out" if code == -signal.SIGKILL else ""
        return f"its process was ended by {signal.Signals(-code).name}{cause}, twice"
    if code is not None:
        return f"its process ended with {code}, twice"
    if isinstance(error, TimeoutError):
        return f"no answer in {error.args[1]:g} s; its process was ended"
    return str(error)


@contextmanager
def local_processes(
    count: int, limit_s: Callable[[Any], float | None] = lambda task: None
) -> Iterator[Executor]:
    """Yield an executor of processes; limit_s: time [s] after which a task is ended.

    More than 4 processes a core, or 64, are refused: each takes 200 MB or more.
    """
    whole_number("jobs", count, 1, max(64, 4 * (os.cpu_count() or 1)))
    import pebble.pool.process
    from pebble import ProcessExpired, ProcessPool

    # pebble counts limits by the system clock; one that is set forward must not end tasks
    vars(pebble.pool.process)["time"] = SimpleNamespace(time=time.monotonic, sleep=time.sleep)
    start = "fork" if sys.platform == "linux" else "spawn"
    pool = ProcessPool(
        count,
        initializer=_prepare_worker,
        initargs=(os.getpid(),),
        context=multiprocessing.get_context(start),
    )
    losses: dict[type[BaseException], FailReason] = {
        ProcessExpired: FailReason.WORKER_DIED,
        TimeoutError: FailReason.WORKER_HUNG,
        MemoryError: FailReason.OUT_OF_MEMORY,
    }
    try:
        yield Executor(
            count,
            lambda f, task: pool.schedule(f, (task,), timeout=limit_s(task)),
            losses,
            attempts=2,
        )
    finally:
        pool.stop()
        pool.join()


def _prepare_worker(parent: int) -> None:
    """End with the parent or on SIGTERM; limit memory, and be killed first when it runs out."""
    end_with_parent(parent)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # compiled code runs no handlers of Python
    limit_memory(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


@contextmanager
def dask_cluster(
    address: str, limit_s: Callable[[Any], float], installed: Callable[[], dict[str, Any]]
) -> Iterator[Executor]:
    """Workers of a Dask cluster, each with an equal `installed()`: what decides results, by name.

    Dask replaces a worker that a task ends, or keeps busy for longer than limit_s [s], and repeats
    the task as often as its scheduler's ``allowed-failures`` says (3); then it is lost.
    InvalidInputError: Dask is not installed, nothing answers at the address, or a worker has
    several threads or something else installed.
    """
    require_installed("distributed", "--dask", "dask")
    from distributed import Client, KilledWorker

    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InvalidInputError(
            f"no Dask scheduler answers at {address}: {error}; start one there"
        ) from error
    with client:
        threads = client.nthreads()
        if not threads:
            raise InvalidInputError(
                f"the Dask scheduler at {address} has no workers; start `dask worker`"
            )
        for worker, count in threads.items():
            if count != 1:
                raise InvalidInputError(
                    f"{worker} runs {count} at a time; start `dask worker --nthreads 1`"
                )
        here = installed()
        for worker, there in client.run(installed, on_error="return").items():
            if isinstance(there, Exception):
                raise InvalidInputError(
                    f"{worker} cannot run planners: {there}; install the same cvqmpt-lab there"
                )
            for what in (name for name in here if here[name] != there[name]):
                raise InvalidInputError(
                    f"{worker} has other {what}; install the same cvqmpt-lab there"
                )
        executor = client.get_executor()
        losses = {KilledWorker: FailReason.WORKER_DIED, MemoryError: FailReason.OUT_OF_MEMORY}
        yield Executor(
            len(threads), lambda f, task: executor.submit(_limited, limit_s(task), f, task), losses
        )


def _limited(limit_s: float, function: Callable[..., Any], *args: Any) -> Any:
    """Call a function; end this process when that takes longer than limit_s [s]."""
    faulthandler.dump_traceback_later(limit_s, exit=True, file=2)  # standard error
    try:
        return function(*args)
    finally:
        faulthandler.cancel_dump_traceback_later()
