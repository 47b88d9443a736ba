"""Several runs of a search in threads, which differ in their seeds: the first path wins.

Compiled code releases Python's lock, so that the runs use several cores. Their results do not
depend on each other: the winner's seed alone gives the same path.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Protocol, Self, TypeVar

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.cell_trees import CellSearch
from cvqmpt_lab.search.planner_interface import Stages

MOST_CORES = 64


class Run(Protocol):
    """A run that can be stopped from another thread."""

    def ended(self) -> Self:
        """Run to the end; return itself."""

    @property
    def won(self) -> bool:
        """Whether it found what ends the race."""

    def stop(self) -> None:
        """Ask it to end soon."""


AnyRun = TypeVar("AnyRun", bound=Run)


def require_race(name: str, stages: Stages) -> None:
    """Refuse a planner whose stages cannot run in threads: networks, OMPL, processes of others."""
    if stages.observe is not None or not isinstance(stages.search or BiRRT(), BiRRT | CellSearch):
        raise InvalidInputError(
            f"cores: {name} runs in one thread; leave cores out, or choose roadmap, birrt or cells"
        )


def first_of(runs: Sequence[AnyRun]) -> AnyRun:
    """Return the run that wins first; the first run if none wins.

    The call returns when all runs have ended, also after an error or Ctrl-C in any thread.
    """
    with ThreadPoolExecutor(len(runs)) as threads:
        running = [threads.submit(run.ended) for run in runs]
        try:
            for ended in as_completed(running):
                if ended.result().won:
                    return ended.result()
        finally:
            for run in runs:
                run.stop()
    return runs[0]
