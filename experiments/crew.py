"""Who carries out the runs of an experiment."""

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass

from cvqmpt_lab.results.row import FailReason
from experiments.workers import WorkerDiedError, WorkerHungError, WorkerPool


@dataclass(frozen=True)
class Crew:
    """An executor, of processes here or of machines elsewhere, and what it does not survive."""

    executor: Executor
    size: int
    """Runs that it carries out at a time."""
    losses: Mapping[type[Exception], FailReason]
    """Errors that mean that a run was lost, which is its result; any other one ends the experiment."""


@contextmanager
def processes(count: int, limit_s: float) -> Iterator[Crew]:
    """Processes on this machine; limit_s: time [s] after which a run is given up."""
    pool = WorkerPool(count, limit_s)
    try:
        yield Crew(
            pool,
            count,
            {
                WorkerDiedError: FailReason.WORKER_DIED,
                WorkerHungError: FailReason.WORKER_HUNG,
                MemoryError: FailReason.OUT_OF_MEMORY,
            },
        )
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
