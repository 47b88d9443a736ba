"""Several runs of a search in threads, which differ in their seeds: the first path wins.

Compiled code releases Python's lock, so that the runs use several cores. Their results do not
depend on each other: the winner's seed alone gives the same path.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TypeVar

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.cell_trees import CellSearch
from cvqmpt_lab.search.planner_interface import Stages

MOST_CORES = 64
Result = TypeVar("Result")


def require_race(name: str, stages: Stages) -> None:
    """Refuse a planner whose stages cannot run in threads: networks, OMPL, processes of others."""
    if stages.observe is not None or not isinstance(stages.search or BiRRT(), BiRRT | CellSearch):
        raise InvalidInputError(
            f"cores: {name} runs in one thread; leave cores out, or choose roadmap, birrt or cells"
        )


def first_of(
    runs: Sequence[Callable[[], Result]], won: Callable[[Result], bool], stop: Callable[[], None]
) -> Result:
    """Return the result of the run that wins first; of the first run if none wins.

    Args:
        runs: functions without arguments, which are called in threads of their own.
        won: whether a result ends the race.
        stop: asks all runs to end soon. It is called when one has won, and after an error or Ctrl-C
            in any thread; the call returns when all runs have ended.
    """
    with ThreadPoolExecutor(len(runs)) as threads:
        running = [threads.submit(run) for run in runs]
        try:
            for ended in as_completed(running):
                if won(ended.result()):
                    return ended.result()
        finally:
            stop()
    return running[0].result()
