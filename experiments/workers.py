"""Processes that work for this one: what dies or hangs costs the call that it was at, and nothing else."""

import contextlib
import multiprocessing
import os
import resource
import signal
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Any

from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.orphans import end_with_parent

Call = tuple[Callable[..., Any], tuple[Any, ...]]
GRACE_S = 5.0  # for a killed process to be gone [s]
CONTEXT: Any = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")


class WorkerDiedError(CvqmptError):
    """The process that was to answer a call ended."""


class WorkerHungError(CvqmptError):
    """The process that was to answer a call did not in time; it was ended."""


class WorkerPool(ThreadPoolExecutor):
    """So many worker processes, each watched by a thread; a call whose process ends is made once more."""

    def __init__(self, workers: int, seconds: float | None = None) -> None:
        """Start them; a call may take so many seconds, or as long as it likes."""
        super().__init__(workers)
        self._seconds, self._lock, self._closed = seconds, Lock(), False
        self._alive: set[_Worker] = set()
        self._idle: SimpleQueue[_Worker] = SimpleQueue()
        for _ in range(workers):  # before there are threads, which forks do not go well with
            self._idle.put(self._started())

    def submit(self, function: Callable[..., Any], /, *args: Any) -> Future:  # type: ignore[override]
        """Call a function in a worker.

        The future raises what the function does; WorkerDiedError when its process ended twice; WorkerHungError.
        """
        return super().submit(self._answer, (function, args))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End all workers: when the calls are answered, or at once."""
        if wait:
            super().shutdown(True, cancel_futures=cancel_futures)
        with self._lock:
            self._closed = True
            for worker in tuple(self._alive):
                worker.end()
        super().shutdown(True, cancel_futures=cancel_futures)

    def _answer(self, call: Call) -> Any:
        try:
            return self._answer_once(call)
        except WorkerDiedError:
            return self._answer_once(call)  # perhaps something else ended it

    def _answer_once(self, call: Call) -> Any:
        worker = self._idle.get()
        try:
            if worker not in self._alive:
                worker = self._started()
            return worker.answer(call, self._seconds)
        except (WorkerDiedError, WorkerHungError):
            self._alive.discard(worker)
            raise
        finally:
            self._idle.put(worker)

    def _started(self) -> "_Worker":
        with self._lock:  # so that no process inherits the pipe that another one's end is to close
            if self._closed:
                raise WorkerDiedError("the workers have been sent home")
            worker = _Worker()
            self._alive.add(worker)
            return worker


class _Worker:
    """A process and the pipe to it."""

    def __init__(self) -> None:
        self._pipe, theirs = CONTEXT.Pipe()
        self._process = CONTEXT.Process(target=_work, args=(theirs, os.getpid()))
        self._process.start()
        theirs.close()

    def answer(self, call: Call, seconds: float | None) -> Any:
        try:
            self._pipe.send(call)
            if not self._pipe.poll(seconds):
                self.end()
                raise WorkerHungError(f"no answer in {seconds:g} s; its process was ended")
            error, value = self._pipe.recv()
        except (EOFError, ConnectionError):
            self.end()
            raise WorkerDiedError(f"its process {_ending(self._process.exitcode)}, twice") from None
        if error is not None:
            raise error
        return value

    def end(self) -> None:
        self._process.kill()
        self._process.join(GRACE_S)


def _ending(code: int | None) -> str:
    if code is None or code >= 0:
        return f"ended with {code}"
    return f"was ended by {signal.Signals(-code).name}" + ("; perhaps memory ran out" if code == -9 else "")


def _work(pipe: Connection, parent: int) -> None:
    """Answer calls until killed."""
    end_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
    _yield_memory()
    while True:
        function, args = pipe.recv()
        answer: tuple[Exception | None, Any]
        try:
            answer = None, function(*args)
        except Exception as error:
            answer = error, None
        pipe.send(answer)


def _yield_memory() -> None:
    """Where memory runs out, let this process be the one that feels it: by an error, or by being ended."""
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
