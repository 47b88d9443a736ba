"""Timing for the benchmarks: medians with spread, and a calibration that compares machines and moments."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.kernels.compiling import kernel

REPEATS = 7


class Figure(NamedTuple):
    """One measured figure: median, smallest and largest over repeats."""

    name: str
    median: float
    low: float
    high: float
    unit: str


def single(name: str, value: float, unit: str) -> Figure:
    """A figure that was not repeated."""
    return Figure(name, float(value), float(value), float(value), unit)


def timed(name: str, call: Callable[[], object], per: int, unit: str = "us") -> Figure:
    """Time a call REPEATS times after a first one; scale to one of `per` items."""
    call()
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    scale = {"us": 1e6, "ms": 1e3, "ns": 1e9}[unit] / per
    return Figure(name, float(np.median(seconds)) * scale, min(seconds) * scale, max(seconds) * scale, unit)


def spread(name: str, values: np.ndarray, unit: str) -> Figure:
    """Median with the 5th and 95th percentile."""
    if len(values) == 0:
        return single(name, np.nan, unit)
    low, median, high = np.quantile(values, (0.05, 0.5, 0.95), method="nearest")
    return Figure(name, float(median), float(low), float(high), unit)


@kernel
def _calibration_loop(n):
    total = 0.0
    for i in range(n):
        total += np.sin(i * 1e-3)
    return total


def calibration() -> Figure:
    """Nanoseconds per sine in a fixed compiled loop."""
    return timed("calibration: sine", lambda: _calibration_loop(100_000), 100_000, "ns")
