"""Runs on a Dask cluster: `dask scheduler` on one machine, `dask worker --nthreads 1` on many."""

import faulthandler
import hashlib
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.results.row import FailReason
from experiments.crew import Crew
from experiments.run import Experiment, weights_of

ROOT = Path(__file__).resolve().parents[1]
ANSWER_S = 10  # for a scheduler to answer [s]
STDERR = 2  # its file descriptor


@contextmanager
def dask_cluster(address: str, experiment: Experiment) -> Iterator[Crew]:
    """Workers of a cluster.

    Dask replaces a worker that a run ends, or keeps busy for longer than the experiment's limit, and tries the run
    again as often as its scheduler's ``allowed-failures`` says (3); then it is lost.

    Raises
    ------
    InvalidInputError
        When Dask is not installed, nothing answers at the address, or a worker has several threads, other
        sources than we have, or other weights for the planners.
    """
    if importlib.util.find_spec("distributed") is None:
        raise InvalidInputError("--dask needs Dask, which is not installed: pip install 'cvqmpt-lab[dask]'")
    from distributed import Client, KilledWorker

    try:
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InvalidInputError(
            f"no Dask scheduler answers at {address}: {error}; start one there"
        ) from error
    with client:
        threads = client.nthreads()
        if not threads:
            raise InvalidInputError(f"the Dask scheduler at {address} has no workers; start `dask worker`")
        for worker, count in threads.items():
            if count != 1:
                raise InvalidInputError(f"{worker} runs {count} at a time; start `dask worker --nthreads 1`")
        _require_same(client, experiment)
        losses = {KilledWorker: FailReason.WORKER_DIED, MemoryError: FailReason.OUT_OF_MEMORY}
        yield Crew(_Watched(client.get_executor(), experiment.limit_s), len(threads), losses)


class _Watched(Executor):
    """Another executor, whose processes end when a call takes too long."""

    def __init__(self, executor: Executor, seconds: float) -> None:
        self._executor, self._seconds = executor, seconds

    def submit(self, function: Callable[..., Any], /, *args: Any) -> Future:  # type: ignore[override]
        """Call a function there."""
        return self._executor.submit(_watched, self._seconds, function, *args)


def _watched(seconds: float, function: Callable[..., Any], *args: Any) -> Any:
    faulthandler.dump_traceback_later(seconds, exit=True, file=STDERR)
    try:
        return function(*args)
    finally:
        faulthandler.cancel_dump_traceback_later()


def _installed(planners: Sequence[str], model: str | None) -> tuple[str, dict[str, str]]:
    """What decides rows, of a machine: digest of our sources, digests of weights."""
    digest = hashlib.sha256()
    for package in ("cvqmpt_lab", "experiments"):
        for path in sorted((ROOT / package).rglob("*.py")):
            digest.update(f"{path.relative_to(ROOT)}".encode() + path.read_bytes())
    return digest.hexdigest(), weights_of(planners, model)


def _require_same(client: Any, experiment: Experiment) -> None:
    asked = experiment.planners, experiment.model
    here = _installed(*asked)
    for worker, there in client.run(_installed, *asked, on_error="return").items():
        if isinstance(there, Exception):
            raise InvalidInputError(
                f"{worker} cannot run planners: {there}; install the same cvqmpt-lab there"
            )
        for ours, theirs, what in zip(here, there, ("sources", "weights"), strict=True):
            if ours != theirs:
                raise InvalidInputError(f"{worker} has other {what}; install the same cvqmpt-lab there")
