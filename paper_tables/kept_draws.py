"""What `rule` and `within` find by random draws, kept in the user's cache.

The draws of all sentences take half a minute. A file of the cache belongs to the values, and to the
source code that judges them.
"""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import scipy

from cvqmpt_lab.base.caches import cached_arrays, sources_digest
from cvqmpt_lab.benchmarks.results import statistics
from cvqmpt_lab.benchmarks.results.statistics import Interval
from cvqmpt_lab.paper_tables import bootstrap, rule, within
from cvqmpt_lab.paper_tables.rule import Effect
from cvqmpt_lab.paper_tables.within import Within, solved_within

SOURCES = (
    Path(__file__),
    *(Path(str(module.__file__)) for module in (rule, within, bootstrap, statistics)),
)
MOST = 1_000  # files of each kind


def kept_effects(own: np.ndarray, other: np.ndarray, level: float) -> list[Effect]:
    """Return `Effect.of_prices`.

    Args:
        own: see `Effect.of_prices`.
        other: see `Effect.of_prices`.
        level: see `Effect.of_prices`.
    """
    found = cached_arrays(
        "effects",
        _made_of(own, other, level),
        lambda: {
            str(k): _lines((effect.means, effect.geometric, *effect.parts))
            for k, effect in enumerate(Effect.of_prices(own, other, level))
        },
        most=MOST,
    )
    made = []
    for k in range(len(own)):
        means, geometric, *parts = map(_interval, found[str(k)])
        made.append(Effect(means, geometric, tuple(parts)))
    return made


def kept_within(own: np.ndarray, other: np.ndarray, limit: float, level: float) -> Within | None:
    """Return `solved_within`.

    Args:
        own: see `solved_within`.
        other: see `solved_within`.
        limit: see `solved_within`.
        level: see `solved_within`.
    """

    def make() -> dict[str, np.ndarray]:
        found = solved_within(own, other, limit, level)
        if found is None:
            return {}
        not_fewer, fewer, time, gain, needed = found
        return {"gain": _lines([gain]), "others": np.array([not_fewer, fewer, time, needed])}

    found = cached_arrays("within", _made_of(own, other, limit, level), make, most=MOST)
    if not found:
        return None
    not_fewer, fewer, time, needed = found["others"].tolist()
    gain = _interval(found["gain"][0])
    return Within(bool(not_fewer), bool(fewer), time, gain, int(needed))


def _made_of(own: np.ndarray, other: np.ndarray, *numbers: float) -> bytes:
    """Return all that a result depends on."""
    versions = sources_digest(*SOURCES), np.__version__, scipy.__version__
    return repr((versions, own.shape, numbers)).encode() + own.tobytes() + other.tobytes()


def _lines(intervals: Iterable[Interval]) -> np.ndarray:
    """Return intervals as lines (k, 4) of estimate, low, high, n; NaN: None."""
    return np.array([item[:4] for item in intervals], dtype=float)


def _interval(line: np.ndarray) -> Interval:
    """Return the interval of a line of `_lines`."""
    estimate, low, high = (None if math.isnan(x) else x for x in line[:3].tolist())
    return Interval(estimate, low, high, int(line[3]))
