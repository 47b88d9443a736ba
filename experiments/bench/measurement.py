"""What is measured, and the one loop that times it: medians with their spread."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from cvqmpt_lab.jit import entry

REPEATS = 7
IN_A_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
Result = TypeVar("Result")


class Measurement(NamedTuple):
    """Something to time, or numbers that were found on the way."""

    name: str
    unit: str
    what: Callable[[], object] | Sequence[float] | np.ndarray
    per: int = 1  # items that a call handles


class Figure(NamedTuple):
    """A measured quantity:
    of calls the median and the extremes, of numbers the median and 5th to 95th percentile.
    """

    name: str
    median: float
    low: float
    high: float
    unit: str


def measured(one: Measurement) -> Figure:
    """Time a call REPEATS times after a first one, or sum up numbers;
    without any the figure is nan.
    """
    if not callable(one.what):
        numbers = np.asarray(one.what, dtype=float)
        low, median, high = (
            np.quantile(numbers, (0.05, 0.5, 0.95), method="nearest")
            if len(numbers)
            else [np.nan] * 3
        )
        return Figure(one.name, float(median), float(low), float(high), one.unit)
    one.what()
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        one.what()
        seconds.append(time.perf_counter() - began)
    scale = IN_A_SECOND[one.unit] / one.per
    return Figure(
        one.name,
        scale * float(np.median(seconds)),
        scale * min(seconds),
        scale * max(seconds),
        one.unit,
    )


class CpuTimes:
    """Processor time [ms] of calls, by name: other processes do not move it."""

    def __init__(self) -> None:
        self._found: dict[str, list[float]] = defaultdict(list)

    def __call__(self, name: str, function: Callable[..., Result], *args: object) -> Result:
        """Call a function and note what it took."""
        began = time.process_time()
        result = function(*args)
        self._found[name].append(1e3 * (time.process_time() - began))
        return result

    def measurements(self) -> Iterator[Measurement]:
        """What was noted, name by name."""
        return (Measurement(name, "ms", found) for name, found in self._found.items())


@entry
def _sines(n: int):
    total = 0.0
    for i in range(n):
        total += np.sin(i * 1e-3)
    return total


CALIBRATION = Measurement("calibration: sine", "ns", lambda: _sines(100_000), 100_000)
"""A fixed compiled loop, which compares machines and moments."""
