"""Executors of an experiment's runs: processes on this machine, by pebble, or a Dask cluster.

A cluster is `dask scheduler` on one machine and `dask worker --nthreads 1` on many.
"""

import faulthandler
import math
import multiprocessing
import os
import resource
import signal
import struct
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple, TypeVar

from cvqmpt_lab.base.arithmetic import PINNED
from cvqmpt_lab.base.errors import (
    CvqmptError,
    InvalidInputError,
    require_installed,
    whole_number,
)
from cvqmpt_lab.base.processes import end_with_parent, limit_memory, processor_time
from cvqmpt_lab.benchmarks.results.row import FailReason

CONNECT_S = 10  # for a scheduler to answer [s]
STOPPED = (
    "the executor of the runs has stopped; what was finished is kept, the same command continues"
)
Task = TypeVar("Task")


class Lost(NamedTuple):
    """Reason why a task has no result: its process ended, hung or ran out of memory."""

    reason: FailReason
    detail: str


class Limit(NamedTuple):
    """When a task is given up. Processor time counts: the clock goes on while others compute."""

    busy_s: float  # processor time of its process and child processes [s]
    idle_s: float = 60.0  # time without use of a processor [s]


@dataclass
class _Watched:
    """A task that a process performs."""

    number: int
    limit: Limit
    pid: int | None = None  # None: it waits for a process
    before: float = 0.0  # processor time of the process before the task [s]
    used: float = 0.0  # processor time that the task has used so far [s]
    idle: float = 0.0  # time since that grew [s]

    def fault(self) -> str | None:
        """Return why the task must be ended, or None; called every POLL_S."""
        if self.pid is None:
            return None
        try:
            used = processor_time(self.pid) - self.before
        except OSError:  # it has ended
            return None
        # counted in calls: the clock also goes on while this process is stopped
        self.idle = self.idle + POLL_S if used == self.used else 0.0
        self.used = used
        if used > self.limit.busy_s:
            return f"no answer in {self.limit.busy_s:g} s of processor time; its process was ended"
        if self.idle > self.limit.idle_s:
            return f"it used no processor for {self.limit.idle_s:g} s; its process was ended"
        return None


@dataclass
class Guard:
    """Ends tasks that reach their limit.

    Each process writes the number of a task and its own id into a pipe when it begins the task.
    """

    pipe: tuple[int, int] = field(default_factory=lambda: os.pipe2(os.O_NONBLOCK))
    ended: dict[Future, str] = field(default_factory=dict)  # why tasks were ended
    _watched: dict[Future, _Watched] = field(default_factory=dict)
    _numbers: Iterator[int] = field(default_factory=count)
    _next: float = 0.0

    def submit(
        self, schedule: Callable[..., Future], limit: Limit, function: Callable, task: Any
    ) -> Future:
        """Start a task by `schedule`, and watch it."""
        number = next(self._numbers)
        future = schedule(_begun, (self.pipe[1], number, function, task))
        self._watched[future] = _Watched(number, limit)
        return future

    def check(self) -> None:
        """End the tasks that have reached their limit; does nothing within POLL_S of the last."""
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + POLL_S
        with suppress(BlockingIOError):
            while message := os.read(self.pipe[0], _BEGUN.size):
                number, pid, before = _BEGUN.unpack(message)
                for one in self._watched.values():
                    if one.number == number:
                        one.pid, one.before = pid, before
        for future, one in list(self._watched.items()):
            if future.done():
                del self._watched[future]
            elif fault := one.fault():
                self.ended[future] = fault
                future.cancel()  # pebble kills its process


_PINNED = " ".join(f"{name}={value!r}" for name, value in PINNED.items())
POLL_S = 1.0  # time between two checks of the limits [s]
_BEGUN = struct.Struct("qqd")  # number of a task, id of the process, its processor time


def _begun(pipe: int, number: int, function: Callable[..., Any], task: Any) -> Any:
    """Tell the guard which process performs a task, and perform it."""
    os.write(pipe, _BEGUN.pack(number, os.getpid(), processor_time(os.getpid())))
    return function(task)


@dataclass(frozen=True)
class Executor:
    """Executor that applies a function to many tasks in parallel."""

    size: int  # tasks at a time
    submit: Callable[..., Future]  # a function and its argument
    # errors that cost one task; any other one is raised
    losses: Mapping[type[BaseException], FailReason]
    attempts: int = 1  # at a task whose process ends: something else may have ended it
    guard: Guard | None = None

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
            done = wait(running, POLL_S if self.guard else None, FIRST_COMPLETED).done
            if self.guard:
                self.guard.check()
            for future in done:
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
            if self.guard and future in self.guard.ended:
                return Lost(FailReason.WORKER_HUNG, self.guard.ended.pop(future))
            raise CvqmptError(STOPPED) from error


def _detail(error: BaseException) -> str:
    """Return the text for the row of a lost task."""
    code = getattr(error, "exitcode", None)  # of pebble.ProcessExpired
    if code is not None and code < 0:
        cause = "; perhaps memory ran out" if code == -signal.SIGKILL else ""
        return f"its process was ended by {signal.Signals(-code).name}{cause}, twice"
    if code is not None:
        return f"its process ended with {code}, twice"
    return str(error)


@contextmanager
def local_processes(size: int, limit: Callable[[Any], Limit] | None = None) -> Iterator[Executor]:
    """Yield an executor of processes; limit: when a task is ended; None: tasks are never ended.

    More than 4 processes a core, or 64, are refused: each takes 200 MB or more.
    """
    whole_number("jobs", size, 1, max(64, 4 * (os.cpu_count() or 1)))
    from pebble import ProcessExpired, ProcessPool

    start = "fork" if sys.platform == "linux" else "spawn"
    pool = ProcessPool(
        size,
        initializer=_prepare_worker,
        initargs=(os.getpid(),),
        context=multiprocessing.get_context(start),
    )
    losses: dict[type[BaseException], FailReason] = {
        ProcessExpired: FailReason.WORKER_DIED,
        MemoryError: FailReason.OUT_OF_MEMORY,
    }
    guard = Guard() if limit and sys.platform == "linux" else None  # it reads /proc

    def submit(function: Callable, task: Any) -> Future:
        if guard is None or limit is None:
            return pool.schedule(function, (task,))
        return guard.submit(pool.schedule, limit(task), function, task)

    try:
        yield Executor(size, submit, losses, attempts=2, guard=guard)
    finally:
        pool.stop()
        pool.join()
        for end in guard.pipe if guard else ():
            os.close(end)


def _prepare_worker(parent: int) -> None:
    """End with the parent or on SIGTERM; limit memory, and be killed first when it runs out."""
    end_with_parent(parent)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # compiled code runs no handlers of Python
    limit_memory(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


@contextmanager
def dask_cluster(
    address: str, limit: Callable[[Any], Limit], installed: Callable[[], dict[str, Any]]
) -> Iterator[Executor]:
    """Workers of a Dask cluster, each with an equal `installed()`: what decides results, by name.

    Dask replaces a worker that a task ends, or that reaches the task's limit, and repeats the task
    as often as its scheduler's ``allowed-failures`` says (3); then it is lost.
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
        for worker, at_once in threads.items():
            if at_once != 1:
                raise InvalidInputError(
                    f"{worker} runs {at_once} at a time; start `dask worker --nthreads 1`"
                )
        here = installed()
        for worker, there in client.run(installed, on_error="return").items():
            if isinstance(there, Exception):
                raise InvalidInputError(
                    f"{worker} cannot run planners: {there}; install the same cvqmpt-lab there"
                )
            for what in (name for name in here if here[name] != there.get(name)):
                cure = "install the same cvqmpt-lab there"
                if what == "arithmetic":
                    cure = f"it uses {there.get(what)}; start it by: env {_PINNED} dask worker ..."
                raise InvalidInputError(f"{worker} has other {what}; {cure}")
        executor = client.get_executor()
        losses = {KilledWorker: FailReason.WORKER_DIED, MemoryError: FailReason.OUT_OF_MEMORY}
        yield Executor(
            len(threads), lambda f, task: executor.submit(_limited, limit(task), f, task), losses
        )


def _limited(limit: Limit, function: Callable[..., Any], *args: Any) -> Any:
    """Call a function; this process ends when it has used `limit.busy_s` of processor time.

    One that uses no processor cannot be seen from inside: it ends after ten times that on the
    clock.
    """
    most = resource.getrlimit(resource.RLIMIT_CPU)[1]
    spent = math.ceil(time.process_time() + limit.busy_s)
    resource.setrlimit(resource.RLIMIT_CPU, (spent, most))
    faulthandler.dump_traceback_later(10.0 * limit.busy_s, exit=True, file=2)  # standard error
    try:
        return function(*args)
    finally:
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_CPU, (most, most))
